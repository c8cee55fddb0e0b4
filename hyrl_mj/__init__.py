"""Hysteresis-Based RL on MuJoCo: learned policies that measurement noise cannot break at a decision.

`run` trains a policy and makes it robust, `robustify` starts from an agent, and `load_run` opens the result.
The stages between are `find_critical_set`, `make_partition`, `extend` and `HybridController`. Importing this
package needs neither torch nor a GL library.
"""

from importlib.metadata import version

import lazy_loader

from hyrl_mj.system import gl as gl  # first: imports mujoco, with a GL backend that exists here

# isort: split
from hyrl_mj import tasks as tasks  # which Gymnasium can make after `import hyrl_mj`

__version__ = version("hyrl-mj")
# The names of `__init__.pyi`, each imported when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
