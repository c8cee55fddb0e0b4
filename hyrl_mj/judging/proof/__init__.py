"""What is proved of a controller: the worst-case game on closed cells, with its answers bounded from outside.

`Certificate` proves what is won from every state and under every noise signal within a bound;
`find_counterexamples` finds signals that really win against the controller. The game decides where cells
cover the chart; `why_no_cells` tells what is in the way.
"""

from hyrl_mj.judging.proof.cells import why_no_cells
from hyrl_mj.judging.proof.certificate import Certificate
from hyrl_mj.judging.proof.counterexamples import CellNoise, find_counterexamples
