import sys
from pathlib import Path

# Replayed bags are those of the evaluation's tests, and of the recorder's.
sys.path.insert(0, str(Path(__file__).parent.parent / "results"))
sys.path.insert(0, str(Path(__file__).parent.parent / "bags"))
