"""Compiles PufferLib's kernel for advantages, from its own source, against the torch that is here.

The kernel in its wheel needs another torch, and a GPU's libraries. Needs g++ and ninja.
"""

import importlib.util
from pathlib import Path

from torch.utils import cpp_extension


def main() -> None:
    """Compile, in place of the wheel's kernel."""
    found = importlib.util.find_spec("pufferlib")
    if found is None or found.origin is None:
        raise ModuleNotFoundError("pufferlib is not installed")
    folder = Path(found.origin).parent
    for kernel in folder.glob("_C.*.so"):
        kernel.unlink()
    cpp_extension.load(
        "_C",
        [str(folder / "extensions" / "pufferlib.cpp")],
        build_directory=str(folder),
        is_python_module=False,
    )


if __name__ == "__main__":
    main()
