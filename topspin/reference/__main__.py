"""Write docs/reference again: `python -m topspin.reference`."""

import sys
from pathlib import Path

from topspin.reference.files import FOLDER, files


def main() -> int:
    """Write all files; return the exit status."""
    for name, text in files().items():
        (Path(FOLDER) / name).write_text(text, encoding="utf-8")
        sys.stdout.write(f"{FOLDER}/{name}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
