"""`python -m deploy.ask URL`: exit status 0 if a service answers 200; else 1, with its answer on stderr.

For health checks in containers, which have no curl.
"""

import sys
import urllib.error
import urllib.request
from collections.abc import Sequence
from typing import Final

TIMEOUT_S: Final = 5.0


def main(argv: Sequence[str]) -> int:
    """Return the exit status."""
    if len(argv) != 1 or not argv[0].startswith("http://"):
        sys.stderr.write(
            f"python -m deploy.ask: {' '.join(argv) or 'nothing'}; allowed: one URL http://...\n"
        )
        return 2
    try:
        with urllib.request.urlopen(argv[0], timeout=TIMEOUT_S) as answer:
            answer.read()
    except urllib.error.HTTPError as error:
        sys.stderr.write(f"{error.code}: {error.read().decode(errors='replace').strip()}\n")
        return 1
    except OSError as error:
        sys.stderr.write(f"{argv[0]}: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
