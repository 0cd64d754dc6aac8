"""Write docs/reference again: `python -m topspin.reference`."""

import argparse
import sys
from pathlib import Path

from topspin.reference.files import FOLDER, files


def main() -> int:
    """Write all files; return the exit status."""
    argparse.ArgumentParser(prog="python -m topspin.reference", description=__doc__).parse_args()
    for name, text in files().items():
        (Path(FOLDER) / name).write_text(text, encoding="utf-8")
        sys.stdout.write(f"{FOLDER}/{name}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
