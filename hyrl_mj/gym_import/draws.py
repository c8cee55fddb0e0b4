"""What resets draw beside the robot's own state, which has to be pinned, and what the user's pins change."""

from __future__ import annotations

import json

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.coordinates import own_of
from hyrl_mj.gym_import.fingerprint import Fingerprint, differing
from hyrl_mj.gym_import.instance import Instance
from hyrl_mj.gym_import.physics import PINNED
from hyrl_mj.gym_import.resets import Resets
from hyrl_mj.gym_import.trials import EPISODES, HELD, SAMPLES

# Resets whose runs are compared, beside those that change something.
COMPARED = 4
# What is drawn where nothing tells it.
UNKNOWN = (
    "something that no attribute holds (or it depends on the clock, on threads, or on chance that no seed "
    "decides: let it compute with the time of MuJoCo, and draw from self.np_random in its reset)"
)
# Of what resets draw of the robot: how much of what runs reach is wide, and by how much of it the ends of
# runs may differ.
WIDE, APART = 1 / 3, 0.15


def check_draws(instance: Instance, resets: Resets, met: np.ndarray) -> str:
    """Returns what resets draw and how it is pinned, to be said to the user; "" if they draw nothing.

    Args:
        instance: the environment.
        resets: what resets lead to.
        met: MuJoCo's states (n, S) that sampled runs have met.

    Raises:
        BadInput: nothing pins what they draw, or what pins it changes nothing, or contradicts something else.
    """
    description, name = instance.spec.description, instance.name
    options, pinned, seed = description.reset, description.pinned, description.seed
    names = _drawn(instance, resets)
    kept = instance.spec.found.get("kept", "").partition(", as ")[0]
    names += _of_robot(instance, resets.states, met)
    changed = _changed_by_user(instance) if options or pinned else set()
    if options and not changed:
        draws = f", which draws {', '.join(names)}" if names else ""
        raise BadInput(
            f"the options of reset {dict(options)} change nothing in {name}{draws}: name the options as its "
            "reset does"
        )
    left = [n for n in names if n not in changed and n.partition("[")[0] not in changed]
    if left and seed is None:
        how = 'with options of reset as {"reset": {"goal_cell": [6, 6]}}'
        if positions := {n: 0.1 for n in left if n.partition("[")[0] in PINNED}:
            how = f"with values as {json.dumps({'pinned': dict(list(positions.items())[:4])})}"
        raise BadInput(
            f"each reset of {name} draws {', '.join(left[:8])}, and what is to be done depends on it: "
            f'pin it, {how}, or as the reset with a seed draws it as {{"seed": 0}}; or let the first step() '
            "note what follows the place that a reset leads to"
        )
    if instance.draws_globally and (left or kept):
        raise BadInput(
            f"each reset of {name} draws {', '.join(left[:8]) or kept} from a global generator of NumPy or "
            "Python, which the seed of reset() does not decide: let it draw from self.np_random"
        )
    if not names:
        return ""
    by_options = f" and {dict(options)}" if options else ""
    by_pins = f", with {dict(pinned)}" if pinned else ""
    return (
        f"{', '.join(names[:8])} as the reset with seed {seed or 0}{by_options} draws it{by_pins}"
    )


def _drawn(instance: Instance, resets: Resets) -> list[str]:
    """Returns the names of what resets draw, beside the robot's own state, and what comes next depends on."""
    states = resets.states
    varies = np.ptp(states, axis=0) > 0
    varies[instance.physics.columns["warmstart"]] = False  # it says nothing of where a run goes
    varies[own_of(instance)] = False
    names = [name for name, v in zip(instance.physics.names, varies, strict=True) if v]
    again = [_begun(instance, states[:1], 0)[0] for _ in range(2)]
    lasting = set(differing(*again))  # what outlasts a reset is not drawn by it
    if own := lasting & {*again[0].generators}:
        raise BadInput(
            f"{instance.name} draws random numbers in reset(), from a generator that its seed does not "
            f"decide ({min(own)}): let it draw from self.np_random"
        )
    telling = [seed for seed, names in enumerate(resets.changes) if names - lasting]
    begun = [
        _begun(
            Instance(instance.spec) if lasting else instance,
            states[: 3 if seed < COMPARED else 1],
            seed,
        )
        for seed in dict.fromkeys((*range(COMPARED), *telling))
    ]
    if lasting:  # nothing has outlasted the first reset of a new instance
        lasting = set(differing(begun[0][0], _begun(Instance(instance.spec), states[:1], 0)[0]))
    first, told = begun[0]
    changed = dict.fromkeys(n for other, _ in begun[1:] for n in differing(first, other))
    of_model = [n for n in changed if n.endswith(" of its model") and n not in lasting]
    passed = {*lasting, *of_model, *(n for found, _ in begun for n in found.generators)}
    differ = [name for name in changed if name not in passed and "_seed" not in name]
    sizes = np.abs(told[np.isfinite(told)])
    most = 1e-9 * max(float(sizes.max(initial=0.0)), 1.0)
    pairs = [
        (other, told if i < COMPARED else told[: len(other)]) for i, (_, other) in enumerate(begun)
    ]
    if all(
        a.shape == b.shape and np.allclose(a, b, rtol=0, atol=most, equal_nan=True)
        for a, b in pairs
    ):
        if differ:
            _keep(
                instance,
                f"{', '.join(differ[:8])}, as the reset that runs begin with leaves it; no trial shows that "
                "what is to be done depends on it",
            )
        return names + of_model
    goals = [name for name in differ if any(word in name for word in ("goal", "target", "task"))]
    return names + of_model + (goals or differ) or [UNKNOWN]


def _keep(instance: Instance, what: str) -> None:
    """Adds to what is said of what stays as a reset leaves it."""
    found = instance.spec.found
    found["kept"] = "; ".join(filter(None, (found.get("kept"), what)))


def _of_robot(instance: Instance, states: np.ndarray, met: np.ndarray) -> list[str]:
    """Returns the names of what resets draw of the robot outside of the chart, if runs depend on it much.

    Runs are played from states that resets lead to, and from the same places with all that is not of the
    chart as runs begin.
    """
    spec, physics = instance.spec, instance.physics
    own = own_of(instance)
    own = own[(np.ptp(states[:, own], axis=0) > 0) & ~np.isin(own, spec.places)]
    if not len(own):
        return []
    reach = np.ptp(np.vstack([met, states]), axis=0)
    hinges = instance.model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    turns = np.intersect1d(own, spec.qpos[instance.model.jnt_qposadr[hinges]])
    reach[turns] = np.minimum(reach[turns], 2 * np.pi)
    usual = states[0].copy()
    usual[spec.qvel[np.isin(spec.qvel, own)]] = 0.0
    depends = bool((np.ptp(states, axis=0)[own] > WIDE * reach[own]).any())
    for seed, state in enumerate(states[:: len(states) // EPISODES]):
        ends = []
        if depends:
            break
        for values in (state, usual):
            start, rng = state.copy(), np.random.default_rng(seed)
            start[own] = values[own]
            instance.put(start)
            results = [*instance.wander(rng, SAMPLES, HELD)]
            ends.append((len(results), physics.read()[spec.places]))
        (k, here), (n, there) = ends
        depends = k != n or bool((np.abs(here - there) > APART * reach[spec.places]).any())
    names = [physics.names[i] for i in own]
    if depends:
        return names
    _keep(
        instance,
        f"{', '.join(names[:8])} of the robot, which resets draw, as the reset that runs begin with leaves "
        "it, at rest; over what they draw, no trial ends elsewhere by more than "
        f"{APART:.0%} of what runs reach",
    )
    return []


def _begun(instance: Instance, starts: np.ndarray, seed: int) -> tuple[Fingerprint, np.ndarray]:
    """Returns what is remembered after a reset to the first start, and what is told from starts (k, S)."""
    remembered, told, rng = None, [], np.random.default_rng(0)
    for start in starts:
        seen = instance.put(start, seed)
        remembered = remembered or instance.memory()
        told.append(seen)
        for k, result in enumerate(instance.wander(rng, samples=100, held=10)):
            instance.take(result)
            # The first reward may be of what shapes it, and alone it is not judged by.
            first = 0 if k or "reward" in instance.spec.criterion.asked else 1
            told += [instance.observation, np.array(instance.report[first:], dtype=float)]
    assert remembered is not None
    return remembered, np.concatenate(told)


def _changed_by_user(instance: Instance) -> set[str]:
    """Returns the names of what the user's options of reset and pinned values change after a reset."""
    found = set(instance.spec.description.pinned)
    for seed in range(COMPARED):
        seen = []
        for plain in (False, True):
            instance.reset(seed, plain)
            seen.append(remembered := instance.memory())
            state = instance.physics.read().tolist()
            remembered.update(zip(instance.physics.names, state, strict=True))
        found.update(differing(*seen))
    return found
