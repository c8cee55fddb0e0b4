"""The hybrid controller of a task, for NumPy alone; written by hyrl-mj export.

It needs the file controller.npz beside it. One sample of the loop:

    q = initial_mode(measured)      # once, from the first measurement
    u, q = step(q, measured)        # jump if the flow set of the mode has been left, then act

Both functions take batches; one robot is a batch of one, with a measurement of shape (1, p).
"""

import numpy as np

with np.load(__file__.rpartition(".")[0] + ".npz", allow_pickle=False) as file:
    ARRAYS = {name: file[name] for name in file.files}

EXPORT = "name"
if ARRAYS.pop("export", None) != EXPORT:
    raise ImportError("controller.npz is of another export than controller.py: export them again")

MODES = ARRAYS["modes"]
NO_MODE = -1  # stands for "in no mode yet"

# ---- the task: the export replaces this part
TASK = "name"
SAMPLE_TIME = 0.05  # [s]
MEASUREMENT_COLUMNS = 1
INPUTS = ("name [unit]",)
# For the network of each mode: the activation between its layers, and what the last layer returns: the value
# of each "level" of the input, or the input itself, to "clip" or to "squash" (by tanh) to its limits.
ACTIVATIONS = [np.tanh]
OUTPUTS = ("clip",)


def chart_point(measured):
    """Returns the chart points (n, d) of measurements (n, p)."""
    return measured


def observation(measured):
    """Returns the observations (n, k) of measurements (n, p), which the networks take."""
    return measured


# ---- the controller


def step(q, measured):
    """Does one sample: jumps where the flow set of the mode has been left, then acts.

    Args:
        q: (n,) int modes.
        measured: (n, p) measurements.

    Returns:
        u (n, m), inputs in the plant's units; q_next (n,) int, the modes after the jumps.

    Raises:
        ValueError: wrong shapes, values that are not finite, or unknown modes.
    """
    q, measured = np.asarray(q), checked(measured)
    if q.shape != (len(measured),):
        raise ValueError(f"{len(measured)} measurements need as many modes, got shape {q.shape}")
    if not np.isin(q, MODES).all():
        raise ValueError(f"modes {q} are unknown: choose from {MODES}")
    return answer(q.astype(np.int64), measured)


def initial_mode(measured):
    """Returns the modes (n,) whose start sets, else flow sets, hold the measurements (n, p) most deeply."""
    measured = checked(measured)
    return answer(np.full(len(measured), NO_MODE), measured)[1]


def checked(measured):
    """Returns measurements as a float array (n, p)."""
    measured = np.asarray(measured, dtype=np.float64)
    if measured.ndim != 2 or measured.shape[1] != MEASUREMENT_COLUMNS:
        raise ValueError(
            f"a measurement has shape (n, {MEASUREMENT_COLUMNS}), got {measured.shape}"
        )
    if not np.isfinite(measured).all():
        raise ValueError("a measurement is not finite")
    return measured


LOW, SIDES, PERIODIC = (ARRAYS[f"chart_{name}"] for name in ("low", "sides", "periodic"))
SCALE = ARRAYS["chart_scale"]
LEAST = 1e-9  # least weight of a scattered node


def answer(q, measured):
    """Does `step` without branches: computes all modes, then chooses one.

    Where q is no mode, the mode whose start set holds the measurement most deeply is chosen. Where a
    measurement is not finite, q stays and u is NaN.
    """
    z, observed = chart_point(measured), observation(measured)
    flow = distances(z, "flow")
    active = q[:, None] == MODES
    flows = (active & (flow <= ARRAYS["on_edge"])).any(axis=1)
    depth = np.where(active, np.inf, flow)
    if "start_0" in ARRAYS:  # without start sets the flow sets decide
        depth = np.where(active.any(axis=1, keepdims=True), depth, distances(z, "start"))
    deepest = np.take(MODES, depth.argmin(axis=1))
    finite = np.isfinite(measured).all(axis=1)
    q_next = np.where(finite & ~flows, deepest, q)
    u = np.nan
    for k in range(len(MODES)):
        u = np.where((finite & (q_next == MODES[k]))[:, None], inputs(observed, k), u)
    return u, q_next


def distances(z, kind):
    """Returns the signed distances (n, modes) of chart points (n, d) to all modes' sets of a kind."""
    turned = np.mod(z - LOW, SIDES)
    # The remainder of a tiny negative number rounds up to the period itself.
    turned = np.where(turned < SIDES, turned, 0.0)
    z = np.where(PERIODIC, LOW + turned, z)
    return np.stack([signed_distance(z, f"{kind}_{k}") for k in range(len(MODES))], axis=1)


def signed_distance(z, name):
    """Returns the distance (n,) of points (n, d) to the edge of a set, negative inside."""
    return scattered(z, name) if f"{name}_nodes" in ARRAYS else on_grid(z, name)


def scattered(z, name):
    """Returns `signed_distance` from scattered nodes.

    The nearest nodes continue their distances along their slopes, and count by their closeness.
    """
    nodes, slopes, count = (ARRAYS[f"{name}_{part}"] for part in ("nodes", "slopes", "nearest"))
    found = np.empty(len(z))
    for i, point in enumerate(z):
        away = point - nodes
        away = np.where(PERIODIC, away - SIDES * np.round(away / SIDES), away) / SCALE
        distance = np.sqrt((away**2).sum(axis=1))
        near = np.argpartition(distance, count - 1)[:count]
        distance, radius = distance[near], distance[near].max()
        # The farthest has no weight: values do not jump where another one takes its place.
        weight = ((radius - distance) / np.maximum(distance, LEAST * radius)) ** 2 + LEAST
        values = ARRAYS[name][near] + (slopes[near] * away[near]).sum(axis=1)
        found[i] = (weight * values).sum() / weight.sum()
    return found


def on_grid(z, name):
    """Returns `signed_distance` from the nodes of a grid."""
    counts, spacing = ARRAYS[f"{name}_counts"], ARRAYS[f"{name}_spacing"]
    last = np.where(PERIODIC, np.inf, counts - 1)
    index = np.minimum(np.maximum((z - LOW) / spacing, 0), last)
    below = np.floor(index)
    share, first = index - below, below.astype(np.int64)
    strides = np.append(np.cumprod(counts[:0:-1])[::-1], 1)
    distance = 0.0
    for corner in np.ndindex(*[2] * len(counts)):
        weight = np.where(np.array(corner, dtype=bool), share, 1 - share).prod(axis=1)
        # Above the last node of an axis lies nothing: the first node counts, with a weight of 0.
        node = ((first + np.array(corner)) % counts * strides).sum(axis=1)
        distance = distance + weight * np.take(ARRAYS[name], node)
    return distance


def inputs(observed, k):
    """Returns inputs (n, m) in the plant's units of a mode's network for observations (n, o)."""
    x = observed.astype(np.float32)
    for i in range(ARRAYS[f"layers_{k}"]):
        x = ACTIVATIONS[k](x) if i else x
        x = x @ ARRAYS[f"weight_{k}_{i}"].T + ARRAYS[f"bias_{k}_{i}"]
    if OUTPUTS[k] == "level":
        return np.take(ARRAYS["levels"], x.argmax(axis=1), axis=0)
    u, low, high = x.astype(np.float64), ARRAYS["input_low"], ARRAYS["input_high"]
    if OUTPUTS[k] == "squash":
        u = low + (np.tanh(u) + 1) / 2 * (high - low)
    return np.minimum(np.maximum(u, low), high)
