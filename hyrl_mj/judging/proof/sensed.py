"""What is proved of controllers under a sensor with a bias, a delay, or samples that are held.

The worst-case game takes one bound that covers all of it, and every signal within it: that is more than the
sensor can do. Here what the sensor remembers is a part of the state. A bias is constant, so that there is a
game for each part of its range. Of a measurement that is late the game knows how old it is, and what the
robot has moved since; whether a sample is held is up to the adversary, who also draws its noise anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from hyrl_mj.judging.game import NEVER, Moves, Places, SensedScore, share, solve
from hyrl_mj.judging.proof.answers import BoundedAnswers
from hyrl_mj.judging.proof.cells import Cells
from hyrl_mj.judging.proof.certificate import Certificate, in_order, staying
from hyrl_mj.simulation import Sensor

# Parts of the range of a bias, for one noisy coordinate and for several. A bias lies anywhere in its part, so
# that failures are wider by half of that: with more parts more is proved.
BIASES, FEWER_BIASES = 8, 3
Shift = tuple[int, ...]


@dataclass(frozen=True)
class Memory:
    """What a sensor that is late can remember, as K numbered memories; an episode begins with the first.

    Attributes:
        shown: (K, d) by how many cells the robot is farther than where it was measured.
        after: (K, S, C) the memories after a sample that shifts the robot by each of S shifts: where the next
            measurement arrives, and where it is held instead.
    """

    shown: np.ndarray
    after: np.ndarray

    @staticmethod
    def of_sensor(shifts: Sequence[Shift], delay: int, hold: int, most: int) -> Memory | None:
        """Returns the memories of a sensor, None if there are more than `most`.

        Args:
            shifts: those by whole cells (d,) that one sample can move the robot.
            delay: how many samples late measurements arrive.
            hold: how many are held in a row, at most.
            most: number of memories.
        """
        none: Shift = (0,) * len(shifts[0])
        # How often the measurement was held, by how much the robot is farther, and its last shifts. Before
        # the start it was at rest.
        first = (0, none, (none,) * max(delay - 1, 0))
        numbers, known, after = {first: 0}, [first], list[list[list[int]]]()
        for held, shown, last in known:
            rows = []
            for shift in shifts:
                since = (*last, shift)
                lately = since[1:] if delay > 1 else ()
                arrives = 0, _sum(since) if delay else none, lately
                stays = held + 1, _sum((shown, shift)), lately
                row = []
                for memory in (arrives, stays if held < hold else arrives)[: 1 + (hold > 0)]:
                    if memory not in numbers:
                        numbers[memory] = len(known)
                        known.append(memory)
                    row.append(numbers[memory])
                rows.append(row)
            after.append(rows)
            if len(known) > most:
                return None
        return Memory(np.array([shown for _, shown, _ in known]), np.array(after))


def _sum(shifts: Sequence[Shift]) -> Shift:
    return tuple(map(sum, zip(*shifts, strict=True)))


def prove_under(
    certificate: Certificate, sensor: Sensor, eps: float
) -> dict[str, SensedScore] | None:
    """Returns what is proved under a sensor of each controller that can be bounded, from all starts.

    It is None if there are none, or a game is too large. What is proved under all noise within the bound
    `eps`, which covers the sensor, is proved under the sensor.
    """
    cells, found = certificate.cells, {}
    for name in certificate.answers:
        assert cells is not None
        if (proved := proved_cells(certificate, name, sensor)) is None:
            return None
        starts = cells.all_corners(certificate.game.starts)
        won = certificate.value(name, eps)[:, : cells.nodes] < NEVER
        of_bound = won[-1], won[:-1].all(axis=0)
        shares = (share((a | b)[starts]) for a, b in zip(proved, of_bound, strict=True))
        found[name] = SensedScore(*shares)
    return found or None


def proved_cells(
    certificate: Certificate, name: str, sensor: Sensor
) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns the cells (N,) bool from which a controller is proved to win under a sensor.

    First those where it picks its start mode, then those from every start mode. It is None if a game is too
    large.

    Args:
        certificate: that under noise which covers what the sensor does.
        name: the controller, which can be bounded.
        sensor: the sensor, of its task.
    """
    cells, answers = certificate.cells, certificate.answers[name]
    assert cells is not None
    task = cells.lattice.task
    added, bias = sensor.bounds(task)
    parts = np.where(bias > 0, BIASES if np.count_nonzero(bias) == 1 else FEWER_BIASES, 1)
    # A robot is this far, at most, from where it would be if the bias were in the middle of its part.
    rest = bias / parts
    wide = cells.widened(rest)
    used = (shift for some in answers.shifts for shift, chosen in some if chosen.any())
    shifts = sorted({tuple(shift.tolist()) for shift in used})
    # States of a game, times what the sensor may do with a sample, take about 50 bytes each.
    most = 2**25 // (cells.nodes * len(answers.goes) * (1 + (sensor.held > 0)))
    own, some = np.ones((2, cells.nodes), dtype=bool)
    for delay in range(sensor.delays[0], sensor.delays[1] + 1):
        memory = Memory.of_sensor(shifts, delay, sensor.held, most)
        if memory is None:
            return None
        for part in product(*map(range, parts)):
            middle = rest * (2 * np.array(part) + 1) - bias
            moves, places = _moves(wide, answers, shifts, memory, added, middle)
            success = np.tile(wide.success, len(memory.shown))
            value = solve(moves, task.max_steps, staying(moves, places, success))
            won = value[:, : cells.nodes] < NEVER  # with the first memory
            own &= cells.within(won[-1], rest)
            some &= cells.within(np.asarray(won[:-1].all(axis=0)), rest)
    return own, some


def _moves(
    cells: Cells,
    answers: BoundedAnswers,
    shifts: list[Shift],
    memory: Memory,
    added: np.ndarray,
    bias: np.ndarray,
) -> tuple[Moves, Places]:
    """Returns the adversary's moves under noise within bounds (d,) and a bias (d,), and the places.

    Places are numbered memory * cells + cell.
    """
    n, many = cells.nodes, len(memory.shown)
    places = Places(*(np.tile(m, many) for m in (cells.arrived, cells.failed, cells.running)))
    shown, occurs = cells.shifted(-memory.shown)
    occurs &= cells.running
    begins = occurs & (np.arange(many) == 0)[:, None]
    rows = []
    for number, row in enumerate(answers.possible(added, bias)):
        here = occurs if number < len(answers.modes) else begins
        parts = []
        for mode, shift, reached in row:
            at, cell = np.nonzero(reached[shown] & here)
            end = cells.after(shift)[cell]
            for to in memory.after[:, shifts.index(tuple(shift.tolist()))].T:
                ends = np.where(end < n, to[at] * n, (many - 1) * n) + end
                parts.append((at * n + cell, np.full(len(at), mode), ends))
        rows.append(in_order(parts))
    return Moves.gather(places, rows), places
