"""Mistakes in a task file: each makes the task impossible, or does harm once it is trained."""

# A mistake by name: what stands in the file, and what takes its place.
Mistakes = dict[str, tuple[str, str]]
# The attributes and methods of the template, by the text that a mistake removes or changes.
CHART = 'Chart(("x", "y"), ("m", "m"), (0.0, -1.5), (3.2, 1.5), (False, False))'
OBSERVATION = "return measured[:, :3]"
REWARD = "return np.where(self.failed(measured), 0.0, 3 - np.abs(measured[:, 1]) - close)"
ENDS = "        return ends\n"
STATE = "return z, np.stack([np.ones(len(z)), drift], axis=1)"
MISS = "return np.abs(z[:, 1])"
OBSERVED = "    def observation(self, measured):"
DANGER = "return -self.clearance(measured)"
LATE = "(measured[:, 0] > 2.2)"  # where a run is after two seconds


def attribute(name: str, old: str, *values: str) -> Mistakes:
    """Returns the mistakes of giving an attribute other values."""
    return {f"{name} = {value}": (f"{name} = {old}", f"{name} = {value}") for value in values}


def part(name: str, old: str, *values: str) -> Mistakes:
    """Returns the mistakes of giving an argument other values."""
    return {f"{name}={value}": (f"{name}={old}", f"{name}={value}") for value in values}


def returns(name: str, old: str, **values: str) -> Mistakes:
    """Returns the mistakes of letting a method return something else."""
    return {f"{name} {what}": (old, new) for what, new in values.items()}


def method(signature: str, bodies: dict[str, str]) -> Mistakes:
    """Returns the mistakes of a method that the template leaves to its base class."""
    return {
        f"{signature.partition('(')[0]}() {what}": (
            OBSERVED,
            f"    def {signature}:\n        {body}\n\n{OBSERVED}",
        )
        for what, body in bodies.items()
    }


def values_of(name: str, old: str, value: str, kind: str = "float") -> Mistakes:
    """Returns the mistakes that any method (n,) can make, early, late, always and in shape."""
    late = f"np.where({LATE}, {{}}, {value})" if "measured" in old or name == "ending()" else ""
    mistakes = {
        "returns NaN": f"return np.full(len({value}), np.nan)",
        "returns None": "return None",
        "returns a column": f"return np.asarray({value})[:, None]",
        "returns one value": f"return np.asarray({value})[0]",
        "returns one too few": f"return np.asarray({value})[1:]",
        "returns words": f"return np.array(['a'] * len({value}))",
        "returns complex numbers": f"return np.asarray({value}) + 1j",
        "raises": "raise KeyError('early')",
        "divides by zero": "return 1 // 0",
    }
    if late:
        mistakes["returns NaN late"] = f"return {late.format('np.nan')}"
        mistakes["raises late"] = (
            f"if {LATE}.any():\n            raise KeyError('late')\n        return {value}"
        )
        mistakes["exits late"] = (
            f"if {LATE}.any():\n            raise SystemExit\n        return {value}"
        )
    return {f"{name} {what}": (old, new) for what, new in mistakes.items()}


REMOVED = {
    f"no {line.split(' =')[0].strip()}": (line, "\n")
    for line in (
        '    name = "puck"\n',
        f"    chart = {CHART}\n",
        '    inputs, input_units = ("lateral",), ("m/s",)\n',
        "    noisy = (False, True, False, False)",
        "    max_steps = 70\n",
        "    start_low, start_high = (0.0, -0.8), (0.3, 0.8)\n",
        "    observation_low, observation_high = (-1.0, -3.0, -3.0), (5.0, 3.0, 3.0)\n",
        "    worst_reward = 0.0",
    )
}
METHODS = {
    f"no {name}()": (f"def {name}(", f"def no_{name}(")
    for name in ("observation", "reward", "ending", "state")
}
TASKS: Mistakes = {
    **REMOVED,
    **METHODS,
    "no scene": ("scene = Scene(", "no_scene = Scene("),
    "no task": ("class Puck(hyrl_mj.Task):", "class Puck:"),
    "a mistake in the first line": ("import numpy as np", "import numpy as np; 1 / 0"),
    "no Python": ("import numpy as np", "impart numpy as np"),
    "a module that nobody has": ("import numpy as np", "import numpy as np, no_such_module"),
    "exits when imported": ("import numpy as np", "import numpy as np; raise SystemExit(0)"),
    **attribute("max_steps", "70", "0", "-1", "70.5", '"70"', "None", "float('nan')", "(70,)", "True"),
    **attribute("worst_reward", "0.0", "np.nan", "-np.inf", "None", '"low"', "10.0"),
    **attribute("close", "0.3", "-1.0", "np.nan", "None", '"near"', "(0.3, 0.3)"),
    **attribute(
        "noisy", "(False, True, False, False)", "(True,)", "(False,) * 4", "(np.nan,) * 4",
        "(-1.0,) * 4", "None", "('y',) * 4",
    ),
    **attribute("set_point", "np.array([3.0, 0.0])", "np.array([3.0])", "np.array([np.nan, 0])", "'end'"),
    **attribute(
        "start_low, start_high", "(0.0, -0.8), (0.3, 0.8)", "(0.3, 0.8), (0.0, -0.8)",
        "(0.0,), (0.3,)", "(np.nan, -0.8), (0.3, 0.8)", "(-9.0, -0.8), (-8.0, 0.8)",
        "(3.05, -0.8), (3.1, 0.8)", "('a', 'b'), ('c', 'd')",
    ),
    **attribute(
        "observation_low, observation_high", "(-1.0, -3.0, -3.0), (5.0, 3.0, 3.0)",
        "(-1.0, -3.0), (5.0, 3.0)", "(-1.0, -3.0, -3.0), (0.1, 3.0, 3.0)",
        "(5.0, 3.0, 3.0), (-1.0, -3.0, -3.0)", "(np.nan,) * 3, (np.nan,) * 3",
        "(-1.0, -3.0, -3.0), (2.0, 3.0, 3.0)",
    ),
    **attribute(
        "chart", CHART, CHART.replace("3.2", "0.0"), CHART.replace("3.2", "np.inf"),
        CHART.replace("3.2", "np.nan"), CHART.replace('("m", "m")', '("m",)'),
        CHART.replace("(False, False)", "(False,)"), '("x", "y")', "None",
    ),
    **part("levels", "5", "1", "0", "-3", "5.5", '"5"', "2**40"),
    **part("horizon", "0.3", "0.0", "-1.0", "float('nan')", '"long"'),
    **part("observation", "(1, -1, -1)", "(1, -1)", "(1, 0, -1)", "(2, 2, 2)", "(1, 1, 1)"),
    **part("inputs", "(-1,)", "(-1, 1)", "(0,)"),
    **part(
        "starts", "((0.0, -0.15), (0.0, 0.0), (0.0, 0.15))", "()", "((9.0, 9.0),)",
        "((float('nan'), 0.0),)", "(0.0, 0.0)", "((0.0,),)",
    ),
    **part("time", "3.2", "0.0", "-1.0", "float('nan')", "1e9", '"long"'),
    **part("mode_names", '("left", "right")', '("left",)', "()", "None"),
    "inputs of nobody": ('inputs, input_units = ("lateral",)', 'inputs, input_units = ("literal",)'),
    "no inputs": ('inputs, input_units = ("lateral",)', "inputs, input_units = ()"),
    **values_of("reward()", REWARD, REWARD.removeprefix("return ")),
    **values_of("ending()", ENDS.strip(), "ends"),
    **values_of("observation()", OBSERVATION, "measured[:, :3]"),
    **values_of("miss()", MISS, "np.abs(z[:, 1])"),
    **values_of("danger()", DANGER, "-self.clearance(measured)"),
    "ending() returns outcomes that do not exist": (ENDS, "        return ends + 40\n"),
    "ending() ends every start": (ENDS, "        return np.full(len(measured), Outcome.CRASHED)\n"),
    "ending() arrives at once": (ENDS, "        return np.full(len(measured), Outcome.REACHED)\n"),
    **method("z(self, measured)", {
        "returns the columns in another order": "return measured[:, 1::-1]",
        "returns NaN": "return measured[:, :2] * np.nan",
        "returns one column": "return measured[:, :1]",
        "returns NaN late": f"return np.where({LATE}[:, None], np.nan, measured[:, :2])",
    }),
    **method("with_z(self, measured, z)", {
        "forgets a column": "return np.hstack([z, measured[:, 3:]])",
        "returns nothing": "pass",
    }),
    "state() forgets the velocities' shape": (STATE, "return z, np.ones(len(z))"),
    "state() returns NaN": (STATE, "return z * np.nan, np.stack([np.ones(len(z)), drift], axis=1)"),
    "state() is elsewhere": (STATE, "return z + 0.5, np.stack([np.ones(len(z)), drift], axis=1)"),
    "state() returns one array": (STATE, "return z"),
    "an observation of the whole past": (
        OBSERVATION, "self.past = getattr(self, 'past', 0) + 1; return measured[:, :3] + self.past"
    ),
}  # fmt: skip
