"""Sets in a task's chart, by their signed distance in scaled units: negative inside, positive outside.

A `GridSet` holds it at the nodes of a `Grid`, or of a `Cloud`, whose nodes are scattered over a chart of many
dimensions; `covering` and `resolving` say which of them a chart gets.
"""

from hyrl_mj.sets.chart import Chart
from hyrl_mj.sets.choice import MOST_DIMENSIONS, coarseness, covering, enough_cells, resolving
from hyrl_mj.sets.clouds import MOST_NODES, Cloud
from hyrl_mj.sets.grids import Grid, shortest_ways, within_reach
from hyrl_mj.sets.members import Complement, Everything, GridSet, Nodes, StateSet
from hyrl_mj.sets.planes import check_points, distance_to

__all__ = [
    "MOST_DIMENSIONS",
    "MOST_NODES",
    "Chart",
    "Cloud",
    "Complement",
    "Everything",
    "Grid",
    "GridSet",
    "Nodes",
    "StateSet",
    "check_points",
    "coarseness",
    "covering",
    "distance_to",
    "enough_cells",
    "resolving",
    "shortest_ways",
    "within_reach",
]
