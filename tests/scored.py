"""Planted results of the worst-case game, for the tests of what is made of them."""

from hyrl_mj.judging.game import LatticeSpacing, LostReplay, ReplayCount, Score

SPACING = LatticeSpacing((0.1,), exact=True, cells=True, curve_spacing=(0.1,))


def replays(who="hyrl", lost=0, of="proved", eps=0.1, start=(3.0,), q0=1):
    """Replays of a controller, of which some are lost without noise."""
    first = LostReplay(start, q0, "none", "crashed") if lost else None
    starts, lost_by_kind = {"none": 400, "uniform": 600}, {"none": lost, "uniform": 0}
    return ReplayCount(who, eps, False, of, starts, lost_by_kind, 50 + lost, first)


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
