"""What is proved of a controller: the worst-case game on closed cells, with its answers bounded from outside.

`Certificate` proves what is won from every state and under every noise signal within a bound; `attack` finds
signals that really win against the controller; `examine` returns both beside the game on the nodes. The game
decides where cells cover the chart (`decides`); `why_no_cells` tells what is in the way.
"""

from hyrl_mj.proof.cells import decides, why_no_cells
from hyrl_mj.proof.certificate import Certificate
from hyrl_mj.proof.counterexamples import Broken, CellNoise, attack
from hyrl_mj.proof.examination import examine

__all__ = ["Broken", "CellNoise", "Certificate", "attack", "decides", "examine", "why_no_cells"]
