import sys
from pathlib import Path

# The builders beside these tests: with import-mode importlib a folder of tests is no package.
sys.path.insert(0, str(Path(__file__).parent))
