"""Earlier names of what the learned planners' comparisons use."""

from shiftsim.verify.files import read_json
from shiftsim.verify.scenes import Scenes as load_scenes

__all__ = ["load_scenes", "read_json"]
