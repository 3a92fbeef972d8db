import sys
from pathlib import Path

# The runs of these tests are bags of the recorder's tests.
sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "bags"))
