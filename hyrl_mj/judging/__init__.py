"""The one place where controllers are judged: `examine` asks all that is asked of them under noise.

Behind it are the worst-case game (`game`), what is proved between its nodes (`proof`), both together
(`worst_case`), noisy episodes, and an attack that searches for noise. `Verdict` is a function of the results.
"""

from hyrl_mj.judging.attacks import Budget, attack, attack_starts
from hyrl_mj.judging.episodes import Regions, noisy_episodes
from hyrl_mj.judging.evidence import VerdictSettings, by_kind
from hyrl_mj.judging.examination import USUAL, Examination, ExamineOptions, Subject, examine
from hyrl_mj.judging.results import Arrivals, Failures, Kind, ModeResult, Retraining
from hyrl_mj.judging.sentences import POLICIES, margin_text, mode_sentence, replays_sentence
from hyrl_mj.judging.verdict import Verdict, Word

__all__ = [
    "POLICIES",
    "USUAL",
    "Arrivals",
    "Budget",
    "Examination",
    "ExamineOptions",
    "Failures",
    "Kind",
    "ModeResult",
    "Regions",
    "Retraining",
    "Subject",
    "Verdict",
    "VerdictSettings",
    "Word",
    "attack",
    "attack_starts",
    "by_kind",
    "examine",
    "game",
    "margin_text",
    "mode_sentence",
    "noisy_episodes",
    "proof",
    "replays_sentence",
]
