"""What a run has made, beside which the alternatives stand: its first policy, and HyRL."""

from collections.abc import Iterator

from hyrl_mj.alternatives.base import Alternative, Candidate, Given, register
from hyrl_mj.learning import Training


@register
class StageOne(Alternative):
    """The policy of stage 1, trained without noise."""

    name = "policy"
    title = "RL policy"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        settings = given.run.settings.stage1
        samples = settings.samples if isinstance(settings, Training) else 0
        yield Candidate("as trained", given.run.controllers["policy"], samples)


@register
class Hyrl(Alternative):
    """The hybrid controller of all stages."""

    name = "hyrl"
    title = "HyRL"

    def candidates(self, given: Given) -> Iterator[Candidate]:
        yield Candidate("as made", given.run.controllers["hyrl"], given.samples)
