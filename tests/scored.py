"""Planted results of the worst-case game, for the tests of what is made of them."""

from hyrl_mj.game import LatticeSpacing, Score

SPACING = LatticeSpacing((0.1,), exact=True, cells=True, curve_spacing=(0.1,))


def score(eps, winnable, won, won_any, *, proved=None, excursion=None, time=3.0):
    """The score of a controller that is beaten where it is lost on the nodes; `proved` for every q0."""
    return Score(
        eps=eps,
        winnable=winnable,
        won=won,
        won_any=won_any,
        time=time,
        time_any=time,
        excursion=excursion,
        open=1.0,
        proved=proved,
        proved_any=proved,
        proved_time=None if proved is None else time,
        proved_time_any=None if proved is None else time,
        not_broken=won,
        not_broken_any=won_any,
    )
