"""Ways past obstacles are told by how planted paths wind about them, whatever the paths look like."""

import copy
from dataclasses import replace
from itertools import product

import mujoco
import numpy as np
import pytest
from planted import ChartPolicy
from planted_field import Driven, Field, along, followed, runs_along

from hyrl_mj import BadInput
from hyrl_mj.policies import PolicyController
from hyrl_mj.simulation import LoopSettings, closed_loop, windings
from hyrl_mj.stages.ways import MOST_MODES, HomotopyClasses
from hyrl_mj.tasks import ANY, LEFT, RIGHT, Outcome, number_of, pattern_of, sides, way_name
from hyrl_mj.tasks.obstacles import MOST_OBSTACLES, islands, sides_of_paths

POST = {"": (2, 0, 0.3)}
ROW = {"_a": (1, 0, 0.3), "_b": (2, 0.2, 0.3), "_c": (3, -0.2, 0.3)}
NO_PAIRS = (np.zeros(0, dtype=int),) * 2


def row(posts):
    """The first posts of a row."""
    return dict(list(ROW.items())[:posts])


def past(posts, sides, start=(0, 0), end=(4, 0)):
    """The path past posts, each one metre to one of its sides."""
    beside = [(x, y + (1 if s == LEFT else -1)) for (x, y, _), s in zip(posts, sides, strict=True)]
    return [start, *beside, end]


def wound(a, b):
    """How often loops along paths a and back along b (S, n, 2) go around the origin, by crossings.

    It counts how often the loop crosses the ray along x, upwards less downwards.
    """
    loop = np.vstack([a, b[::-1], a[:1]])
    below, above = loop[:-1], loop[1:]
    rise = np.sign(above[..., 1]) - np.sign(below[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = -below[..., 1] / (above[..., 1] - below[..., 1])
    at = below[..., 0] + share * (above[..., 0] - below[..., 0])
    return np.where((rise != 0) & (at > 0), rise / 2, 0).sum(axis=0)


# ---- angles


@pytest.mark.parametrize("posts", [1, 2, 3])
def test_two_runs_differ_at_the_posts_that_they_pass_on_different_sides(posts):
    field = Field(row(posts))
    ways = np.array([*product((LEFT, RIGHT), repeat=posts)])
    passing = followed(field, along(*(past(field.posts, way) for way in ways)))
    n = len(ways)
    first, second = np.divmod(np.arange(n * n), n)
    wind = windings(passing[first], passing[second])
    np.testing.assert_array_equal(wind != 0, ways[first] != ways[second])
    assert set(wind.ravel()) == {-1, 0, 1}
    np.testing.assert_array_equal(wind, windings(passing[second], passing[first]) * -1)


@pytest.mark.slow
def test_it_is_as_often_as_crossings_say_for_any_paths():
    rng, n = np.random.default_rng(0), 100
    a, b = rng.normal(size=(2, 12, n, 2))  # long steps, and any ends
    parts = np.linspace(0, 1, 60)
    fine = [along(*p.transpose(1, 0, 2), samples=len(parts) * 11) for p in (a, b)]
    field = Field({"": (0, 0, 0.1)})
    field.ending = lambda measurement: np.full(len(measurement), Outcome.RUNNING)
    passing = [followed(field, path) for path in fine]
    wind = windings(*passing)[:, 0]
    np.testing.assert_array_equal(wind, wound(*fine))
    assert len(set(wind)) > 4
    around = passing[0].turned - passing[1].turned
    assert np.abs(around % (2 * np.pi)).max() > 1, "the ends lie apart, and do not matter"


@pytest.mark.slow
def test_no_threshold_decides():
    field = Field(POST)
    hair = 1e-7  # [m] beside the middle of the post
    paths = [[(0, 0), (2, y), (4, 0)] for y in (hair, 1.9, -hair, -1.9)]
    passing = followed(field, along(*paths, samples=401))
    at = np.arange(4)
    table = windings(passing[at.repeat(4)], passing[np.tile(at, 4)]).reshape(4, 4)
    np.testing.assert_array_equal(table, np.array([[0, 0, -1, -1]] * 2 + [[1, 1, 0, 0]] * 2))


# ---- sides, numbers and names


def test_a_post_that_is_behind_or_far_off_says_nothing():
    centres = np.array([[1.0, 0.0], [3.0, 0.0]])
    before, between = past([(1, 0, 0), (3, 0, 0)], [LEFT, RIGHT]), [(2, 0), (3, 1), (4, 0)]
    behind, beside = [(3.2, 1.0), (4, 0)], [(0, 2.5), (4, 2.5)]
    seen = sides_of_paths(along(before, between, behind, beside), centres)
    # A post is far off if it lies outside the circle over the ends of a run.
    assert seen.tolist() == [[LEFT, RIGHT], [ANY, LEFT], [ANY, ANY], [ANY, ANY]]


@pytest.mark.parametrize("obstacles", [1, 2, 3])
def test_every_pattern_has_a_number_of_its_own(obstacles):
    patterns = np.array([*product((LEFT, RIGHT, ANY), repeat=obstacles)])
    numbers = number_of(patterns)
    assert len(set(numbers)) == len(patterns)
    for pattern, number in zip(patterns, numbers, strict=True):
        np.testing.assert_array_equal(pattern_of(int(number), obstacles), pattern)


def test_the_most_obstacles_have_numbers_too():
    pattern = np.full((1, MOST_OBSTACLES), ANY)
    number = int(number_of(pattern)[0])
    assert number > 0
    np.testing.assert_array_equal(pattern_of(number, MOST_OBSTACLES), pattern[0])


def test_ways_are_named_after_the_obstacles():
    assert [way_name(np.array([side]), [""]) for side in (LEFT, RIGHT)] == ["left", "right"]
    assert way_name(np.array([LEFT, ANY, RIGHT]), ["a", "b", "c"]) == "left of a, right of c"
    assert way_name(np.array([ANY, ANY]), ["a", "b"]) == "any way"
    assert Field(row(2)).mode_name(1) == "1 (right of a, left of b)"
    assert Field(POST).mode_name(1) == "1 (right)"


# ---- obstacles


def test_geoms_that_touch_are_one_island():
    wall = '<geom name="obstacle_{}" type="box" size="0.5 0.1 0.1" pos="{} 0 0"/>'
    parts = [("c", 2), ("a", 0), ("b", 1), ("far", 3.5)]  # a and c touch b only
    walls = "".join(wall.format(*part) for part in parts)
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{walls}</worldbody></mujoco>")
    found = islands(model)
    assert [*found] == ["c", "far"]
    assert model.geom(found["far"]).pos[0] == 3.5


def test_posts_that_move_are_no_islands():
    geom = '<geom name="obstacle_{}" size="0.3" mass="1"/>'
    bodies = f'<body>{geom.format("a")}</body><body mocap="true">{geom.format("c")}</body>'
    bodies += f'<body><joint type="slide"/>{geom.format("b")}</body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    assert [*islands(model)] == ["a", "c", "b"]


def test_more_obstacles_than_have_numbers_are_one_sentence():
    posts = {f"_{k}": (k, 0, 0.3) for k in range(MOST_OBSTACLES + 1)}
    assert len(islands(Field(dict(list(posts.items())[1:])).model)) == MOST_OBSTACLES
    with pytest.raises(BadInput, match=r"field has 31 obstacles, .* at most 30: give .* direction"):
        islands(Field(posts).model)


@pytest.mark.parametrize("driven", ["mocap", "joint"])
def test_an_obstacle_that_moves_is_followed(driven):
    field = Driven() if driven == "mocap" else Field(driven=driven)
    # The robot keeps to y = 0, and the post crosses from its left to its right, or the other way.
    right, left = ([(0, 0, side), (2, 0, side), (4, 0, -side)] for side in (1, -1))
    passing = followed(field, along(right, left))
    assert windings(passing[:1], passing[1:]).tolist() == [[1]]
    assert sides(-passing.turned).tolist() == [[RIGHT], [LEFT]]


def test_an_obstacle_that_moves_is_where_it_is_at_once_and_after_each_step():
    field = Driven()
    plant, z = field.plant(2), np.array([[0.0, 0.0, 0.5], [1.0, 0.0, -0.5]])
    plant.set_state(*field.state(z))
    [post] = field.obstacles.values()
    for copied in (plant, copy.deepcopy(plant)):
        np.testing.assert_allclose(copied.geom_positions([post])[:, 0, 1], [0.5, -0.5])
    plant.set_state(field.state(z)[0][::-1], np.tile([0.0, 0.0, 1.0], (2, 1)))
    np.testing.assert_allclose(plant.geom_positions([post])[:, 0, 1], [-0.5, 0.5])
    plant.step(np.zeros((2, 2)))
    np.testing.assert_allclose(plant.geom_positions([post])[:, 0, 1], [-0.45, 0.55])


def test_the_closed_loop_follows_it_as_well():
    field = Field(POST)
    ahead = ChartPolicy(field, lambda z: np.stack([1 + 0 * z[:, 0], np.sign(z[:, 1])], axis=1))
    z0 = np.array([[0.0, 0.1], [0.0, -0.1]])
    settings = LoopSettings(passing=True, quiet=True)
    rollout = closed_loop(field, PolicyController(ahead), z0, settings=settings)
    planted = followed(field, rollout.path)
    np.testing.assert_allclose(rollout.passing.turned, planted.turned, atol=1e-6)
    assert np.sign(planted.turned).ravel().tolist() == [-1, 1]


def test_a_path_of_chart_points_tells_the_way_alone():
    class Turned(Field):
        """Its plane is that of y and x."""

        plane = (1, 0)

        def where(self, measured):
            return measured[:, ::-1]

    left, right = [(0, 0), (2, 1), (4, 0)], [(0, 0), (2, -1), (4, 0)]
    path = along(left, right, [(3, 1), (4, 0)])
    assert Field(POST).direction(path).tolist() == [LEFT, RIGHT, ANY]
    assert Turned(POST).direction(path).tolist() == [RIGHT, LEFT, ANY]
    moving = along(*([(0, 0, side), (2, 0, side), (4, 0, -side)] for side in (-1, 1)))
    assert Driven().direction(moving).tolist() == [LEFT, RIGHT]


# ---- modes


def test_modes_are_the_patterns_of_which_no_other_says_more():
    field = Field(row(2))
    starts = [past(field.posts, way) for way in ((LEFT, LEFT), (LEFT, RIGHT), (RIGHT, RIGHT))]
    between = [past(field.posts[1:], [side], start=(1.6, 0.1)) for side in (LEFT, RIGHT)]
    behind = [(3.5, 0.5), (4, 0)]
    runs = runs_along(field, along(*starts, *between, behind))
    ways = HomotopyClasses.from_runs(field, runs, NO_PAIRS)
    assert ways.patterns.tolist() == [[LEFT, LEFT], [LEFT, RIGHT], [RIGHT, RIGHT]]
    assert ways.modes == (0, 2, 3), "in the order of their numbers"
    belongs = {
        "LL": [1, 0, 0], "LR": [0, 1, 0], "RR": [0, 0, 1],
        "any L": [1, 0, 0], "any R": [0, 1, 1], "any any": [1, 1, 1],
    }  # fmt: skip
    assert ways.members(runs).astype(int).tolist() == [*belongs.values()]


def to_the_middle(posts):
    """Paths from both sides of a set-point between two posts, past the nearer one on its left and right."""
    (a, b), middle = posts[:, 0], (2, 0)
    ways = {(end, y): [(end, 0), (at, y), middle] for end, at in ((0, a), (4, b)) for y in (1, -1)}
    return {"L any": ways[0, 1], "R any": ways[0, -1], "any R": ways[4, 1], "any L": ways[4, -1]}


def test_modes_say_how_to_pass_what_no_start_has_to_pass_together():
    field = Field({"_a": (1, 0, 0.3), "_b": (3, 0, 0.3)})
    paths = to_the_middle(field.posts)
    runs = runs_along(field, along(*paths.values()))
    ways = HomotopyClasses.from_runs(field, runs, NO_PAIRS)
    assert ways.patterns.tolist() == [[LEFT, LEFT], [RIGHT, LEFT], [LEFT, RIGHT], [RIGHT, RIGHT]]
    belongs = {
        "L any": [1, 0, 1, 0], "R any": [0, 1, 0, 1], "any R": [0, 0, 1, 1], "any L": [1, 1, 0, 0],
    }  # fmt: skip
    assert ways.members(runs).astype(int).tolist() == [belongs[way] for way in paths]


def test_modes_do_not_say_together_what_hardly_any_run_does():
    field = Field({"_a": (1, 0, 0.3), "_b": (3, 0, 0.3)})
    many = [path for path in to_the_middle(field.posts).values() for _ in range(50)]
    rare = [(0, 0), (1, -1), (3, -1), (4, 0), (3, 1), (2, 0)]  # to the right of a, and to that of b
    runs = runs_along(field, along(*many, rare, samples=40))
    ways = HomotopyClasses.from_runs(field, runs, NO_PAIRS)
    assert ways.dropped == (number_of(np.array([[RIGHT, RIGHT]]))[0],)
    assert ways.patterns.tolist() == [[LEFT, LEFT], [RIGHT, LEFT], [LEFT, RIGHT]]


def test_without_a_decision_there_is_no_mode():
    field = Field({"_a": (1, 0, 0.3)})
    runs = runs_along(field, along([(0, 0), (1, 1), (4, 0)], [(0, 0.1), (1, 1), (4, 0)]))
    assert HomotopyClasses.from_runs(field, runs, (np.array([0]), np.array([1]))).modes == ()


def test_a_post_that_all_pass_on_one_side_is_in_no_pattern():
    field = Field(row(2))
    runs = runs_along(field, along(*(past(field.posts, (side, LEFT)) for side in (LEFT, RIGHT))))
    ways = HomotopyClasses.from_runs(field, runs, NO_PAIRS)
    assert ways.patterns.tolist() == [[LEFT, ANY], [RIGHT, ANY]]
    assert field.mode_name(ways.modes[1]).endswith("(right of a)")


@pytest.mark.parametrize(("rare", "kept"), [(1, False), (2, True)])
def test_a_way_that_hardly_any_node_goes_is_no_mode(rare, kept):
    field = Field(row(2))
    few = [past(field.posts, (RIGHT, LEFT))] * rare
    many = [past(field.posts, (side, side)) for side in (LEFT, RIGHT) for _ in range(99)]
    paths = along(*many, *few, samples=40)
    runs = runs_along(field, paths)
    ways = HomotopyClasses.from_runs(field, runs, NO_PAIRS)
    number = int(number_of(np.array([[RIGHT, LEFT]]))[0])
    assert (number in ways.modes) == kept
    assert ways.dropped == (() if kept else (number,))
    assert ways.works(runs).tolist() == [True] * 198 + [kept] * rare


def test_nodes_inside_of_walls_make_no_way_rare():
    field = Field(row(1))
    paths = [past(field.posts, (side,)) for side in (LEFT, RIGHT)] + [[(4, 0), (4, 0)]] * 400
    runs = runs_along(field, along(*paths, samples=40), np.arange(402) < 2)
    alive = np.arange(402) < 2
    ways = HomotopyClasses.from_runs(field, replace(runs, alive=alive, arrived=alive), NO_PAIRS)
    assert ways.modes == (0, 1)
    assert ways.dropped == ()


@pytest.mark.parametrize("arrive", [(True, False, True, True), (False,) * 4])
def test_only_runs_that_arrive_make_modes_and_all_do_if_none_arrives(arrive):
    field = Field(row(2))
    paths = along(*(past(field.posts, way) for way in product((LEFT, RIGHT), repeat=2)))
    runs = runs_along(field, paths, np.array(arrive))
    ways = HomotopyClasses.from_runs(field, runs, NO_PAIRS)
    assert ways.arriving == any(arrive)
    assert len(ways.modes) == (sum(arrive) or 4)
    assert ([LEFT, RIGHT] in ways.patterns.tolist()) == (not ways.arriving)
    assert ways.arriving or ways.works(runs).all()


@pytest.mark.parametrize("posts", [5, 6])
def test_more_ways_than_modes_are_one_sentence(posts):
    field = Field({f"_{k}": (0.5 + 0.55 * k, 0, 0.1) for k in range(posts)})
    patterns = [*product((LEFT, RIGHT), repeat=posts)]
    runs = runs_along(field, along(*(past(field.posts, way) for way in patterns)))
    if 2**posts <= MOST_MODES:
        assert len(HomotopyClasses.from_runs(field, runs, NO_PAIRS).modes) == 2**posts
        return
    with pytest.raises(
        BadInput, match=r"field has 64 ways, .* at most 32 modes: .*direction"
    ) as error:
        HomotopyClasses.from_runs(field, runs, NO_PAIRS)
    assert "\n" not in str(error.value)
