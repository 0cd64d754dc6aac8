"""Write the files of deploy/monitoring and deploy/cluster again: `python -m deploy.manifests`."""

import argparse
import sys

from deploy.manifests.files import FOLDER, files


def main() -> int:
    """Write all files; return the exit status."""
    argparse.ArgumentParser(prog="python -m deploy.manifests", description=__doc__).parse_args()
    for name, text in files().items():
        path = FOLDER / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        path.chmod(0o755 if text.startswith("#!") else 0o644)
        sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
