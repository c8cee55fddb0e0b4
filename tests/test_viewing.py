"""The viewers: how an arc is played, who can reach the page, and what is said where none opens."""

import os
import re
import socket
import sys
import threading
import urllib.error
import urllib.request
from contextlib import contextmanager

import mujoco
import numpy as np
import pytest
from command_line import listening
from planted import ideal_controller

import hyrl_mj
from hyrl_mj import BadInput
from hyrl_mj.viz import live, viewing
from hyrl_mj.viz.replay import marks
from hyrl_mj.viz.replay.panel import Track


@pytest.fixture(scope="module")
def arc(vehicle):
    """Half a second of the vehicle."""
    return hyrl_mj.simulate(vehicle, ideal_controller(vehicle), [0.0, 0.05], horizon=0.5)


# ---- the loop


class Clock:
    """Stands in for the module time: it goes on when somebody sleeps."""

    def __init__(self):
        self.now = 100.0
        self.slept = []

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now += seconds


class Recorder:
    """Stands in for a viewer: it keeps the data that it is shown, and takes some time over it."""

    def __init__(self, data, clock, frames, takes=0.0):
        self.data, self.clock, self.frames, self.takes = data, clock, frames, takes
        self.t, self.qpos, self.seen = [], [], []

    def is_running(self):
        return len(self.t) < self.frames

    def sync(self):
        self.t.append(self.data.time)
        self.qpos.append(self.data.qpos.copy())
        self.seen.append(self.clock.now)
        self.clock.now += self.takes


@pytest.fixture
def play(vehicle, arc, monkeypatch):
    """A function that plays the arc for some frames, and tells what was shown when."""

    def run(frames, takes=0.0):
        clock, data = Clock(), mujoco.MjData(vehicle.model)
        monkeypatch.setattr(viewing, "time", clock)
        viewer = Recorder(data, clock, frames, takes)
        viewing.play(Track(vehicle, arc), vehicle.model, data, viewer)
        return viewer

    return run


def test_an_arc_is_played_at_sixty_hertz_held_at_its_end_and_begun_again(play, vehicle, arc):
    frames = int(viewing.FPS * (arc.t[-1] + viewing.PAUSE)) + 20
    viewer = play(frames)
    t, qpos = np.array(viewer.t), np.array(viewer.qpos)
    np.testing.assert_allclose(np.diff(viewer.seen), 1 / 60)
    track = Track(vehicle, arc)
    np.testing.assert_allclose(qpos, [track.qpos(min(at, track.end)) for at in t])
    held = t >= track.end
    assert held.sum() == pytest.approx(viewing.FPS * viewing.PAUSE, abs=1)
    assert (qpos[held] == track.qpos(track.end)).all()
    (again,) = np.flatnonzero(np.diff(t) < 0)
    np.testing.assert_allclose(np.diff(t[: again + 1]), 1 / 60)
    np.testing.assert_allclose(np.diff(t[again + 1 :]), 1 / 60)


def test_the_time_that_a_viewer_takes_is_part_of_the_sixtieth(play):
    np.testing.assert_allclose(np.diff(play(30, takes=0.01).seen), 1 / 60)


def test_behind_a_slow_viewer_the_arc_stays_in_real_time(play):
    viewer = play(5, takes=0.1)
    np.testing.assert_allclose(viewer.t, [0.0, 0.1, 0.2, 0.3, 0.4], atol=1e-9)
    assert viewer.clock.slept == [0.0] * 5


def test_nothing_is_shown_when_the_viewer_is_closed(play):
    assert play(0).t == []


# ---- in a browser


class Enough(Exception):
    """Ends a viewer from inside, as Ctrl+C does."""


@pytest.fixture
def headless(monkeypatch):
    monkeypatch.setattr(viewing, "has_display", lambda: False)


def port_of(said):
    """The port in the sentence that says where the page is."""
    return int(re.search(r"http://127\.0\.0\.1:(\d+)/", said)[1])


@contextmanager
def taken_port():
    """A port to which somebody else listens."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        yield other.getsockname()[1]


def free_port():
    with taken_port() as port:
        return port


def page_of(port, **options):
    """The web socket of the page, as a browser opens it."""
    import viser
    from websockets.sync.client import connect

    kind = [f"viser-v{viser.__version__}"]
    return connect(f"ws://127.0.0.1:{port}", subprotocols=kind, max_size=None, **options)


@pytest.mark.slow
def test_the_page_is_served_to_this_machine_alone(vehicle, arc, headless, capsys, caplog):
    from websockets.exceptions import InvalidStatus

    port, said = free_port(), []

    def look(text):
        said.append(text)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=20) as page:
            assert b"<html" in page.read().lower()
        for name, value in (("Host", "evil.example"), ("Origin", "http://evil.example")):
            request = urllib.request.Request(f"http://127.0.0.1:{port}/", headers={name: value})
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(request, timeout=20)
        for headers in ({"Host": "evil.example"}, {"Origin": "null"}, {"Origin": "http://["}):
            with pytest.raises(InvalidStatus), page_of(port, additional_headers=headers):
                raise AssertionError  # a second host, or a page of somebody else's
        for content in (b"\xdd\xff\xff\xff\xff", b"\x91" * 100_000, "text", os.urandom(1_000)):
            with page_of(port) as page:
                page.recv(timeout=10)
                page.send(content)
        with page_of(port) as page:
            page.recv(timeout=10)  # it still serves who asks for more
        if sys.platform == "linux":
            assert [address for address, at, _ in listening() if at == port] == ["0100007F"]
        raise Enough

    with pytest.raises(Enough):
        viewing.view(vehicle, arc, port, look)
    assert port_of(said[0]) == port
    assert "only from this machine" in said[0]
    assert not [record for record in caplog.records if record.exc_info]
    assert capsys.readouterr() == ("", "")  # viser's own words are not ours
    with pytest.raises(ConnectionRefusedError):  # and nobody listens any more
        socket.create_connection(("127.0.0.1", port), timeout=5)


@pytest.mark.slow
def test_who_has_the_page_open_sees_the_robot_move(vehicle, arc, headless, monkeypatch):
    received = []
    open_page = threading.Event()

    def watch(port):
        with page_of(port) as page:
            try:
                while True:  # first the scene, and then a long time nothing
                    page.recv(timeout=1)
            except TimeoutError:
                open_page.set()
            for _ in range(20):
                received.append(page.recv(timeout=10))

    def play(track, model, data, viewer):
        assert viewer.is_running()
        assert open_page.wait(30)
        for frame in range(1, 1000):
            viewing.show(track, model, data, frame / 100)
            viewer.sync()
            thread.join(0.02)
            if not thread.is_alive():
                return

    def say(text):
        nonlocal thread
        thread = threading.Thread(target=watch, args=(port_of(text),))
        thread.start()

    thread = None
    monkeypatch.setattr(viewing, "play", play)
    viewing.view(vehicle, arc, say=say)
    assert len(received) == 20


@pytest.mark.slow
def test_without_a_port_the_first_free_one_from_8080_on_is_taken(vehicle, arc, headless):
    said = []

    def end(text):
        said.append(text)
        raise Enough

    try:
        other = socket.create_server(("127.0.0.1", 8080))
    except OSError:  # somebody has it
        other = None
    try:
        with pytest.raises(Enough):
            viewing.view(vehicle, arc, say=end)
    finally:
        if other is not None:
            other.close()
    assert 8080 < port_of(said[0]) < 8180


def test_a_port_that_is_taken_and_a_number_that_is_none_are_refused(vehicle, arc, headless):
    with taken_port() as taken:
        for port in (taken, 70_000, 65_536, -1):
            with pytest.raises(BadInput, match=f"port {port} cannot be used .*1024 to 65535"):
                viewing.view(vehicle, arc, port)


@pytest.mark.parametrize("package", ["mjviser", "viser"])
def test_without_the_extra_one_sentence_says_how_to_get_it(
    package, vehicle, arc, headless, monkeypatch
):
    monkeypatch.setitem(sys.modules, package, None)
    sentence = 'needs the package mjviser .* pip install "hyrl-mj\\[view\\]", or .* hyrl-mj replay'
    with pytest.raises(BadInput, match=sentence) as caught:
        viewing.view(vehicle, arc)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 2


# ---- in a window


def test_with_a_display_mujoco_s_own_viewer_plays_it(vehicle, arc, monkeypatch):
    played = []

    @contextmanager
    def launch_passive(model, data):
        played.append(model)
        yield "the window"

    monkeypatch.setattr(viewing, "has_display", lambda: True)
    monkeypatch.setitem(sys.modules, "mjviser", None)  # it is not asked for
    monkeypatch.setattr("mujoco.viewer.launch_passive", launch_passive)
    monkeypatch.setattr(viewing, "play", lambda *given: played.append(given[3]))
    viewing.view(vehicle, arc)
    model, viewer = played
    assert viewer == "the window"
    assert model is not vehicle.model


def test_a_window_that_cannot_be_opened_is_one_sentence(vehicle, arc, monkeypatch):
    def launch_passive(model, data):
        raise RuntimeError("run it under mjpython")

    monkeypatch.setattr(viewing, "has_display", lambda: True)
    monkeypatch.setattr("mujoco.viewer.launch_passive", launch_passive)
    with pytest.raises(
        BadInput, match=r"cannot be opened \(run it under mjpython\): .* hyrl-mj replay"
    ):
        viewing.view(vehicle, arc)


# ---- live


@pytest.fixture(scope="module")
def page(planted_circle):
    """The controls of the page of a run of the circle, on a server that nobody has opened."""
    import viser

    server = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
    yield live.Page(planted_circle[0], server)
    server.stop()


def chosen(page, start, controller="HyRL", mode=live.SELECTED, noise="alternating", bound=0.1):
    """The arc that the page shows for what is chosen on it."""
    page.start[0].value, page.bound.value = start, bound
    page.controller.value, page.mode.value, page.noise.value = controller, mode, noise
    page.advance(0.0)
    return page.track.arc


@pytest.mark.slow
def test_what_is_chosen_is_simulated_as_in_python(page):
    run = page.run
    for controller, name in live.CONTROLLERS.items():
        arc = chosen(page, 3.0, controller, noise="uniform", bound=0.05)
        noise = hyrl_mj.Noise("uniform", 0.05)
        alone = hyrl_mj.simulate(run.task, run.controllers[name], [3.0], noise=noise)
        np.testing.assert_array_equal(arc.z, alone.z)
    for q in run.extended_sets.modes:
        assert chosen(page, np.pi, mode=run.task.mode_name(q)).q[0] == q
    arc = chosen(page, 3.0, noise="uniform")
    page._draw_again(None)
    page.advance(0.0)
    assert (page.track.arc.measured[0] != arc.measured[0]).any()


@pytest.mark.slow
def test_the_start_is_where_the_handle_has_been_dragged(page):
    chosen(page, 3.0)
    task = page.run.task
    page.handle.position = marks.tracked_points(task, task.state(np.array([[1.0]]))[0])[0]
    page._drag(None)
    page.advance(0.0)
    assert page.track.arc.z[0, 0] == pytest.approx(1.0, abs=2 * np.pi / live.PLACES)


def test_what_is_measured_the_mode_and_the_time_are_shown(page):
    arc, task = chosen(page, 3.0), page.run.task
    page.playing.value = True
    page.advance(0.12)
    assert page.t == pytest.approx(0.12)
    page._stepped.set()
    page.advance(1.0)
    assert page.t == pytest.approx(0.12 + task.dt)
    assert not page.playing.value
    page.advance(1.0)
    assert page.t == pytest.approx(0.12 + task.dt)  # it stands
    row = arc.at(page.t)
    measured = marks.tracked_points(task, task.state(task.z(arc.measured[row : row + 1]))[0])[0]
    np.testing.assert_allclose(page._ghost.position, measured, atol=1e-6)
    assert page._label.text == task.mode_name(int(arc.q[row]))
    assert f"t = {page.t:.2f} s" in page.told.content


def test_what_cannot_be_simulated_is_said_on_the_page(page):
    before = chosen(page, 3.0)
    page.bound.value = -1.0
    page._simulate()
    assert "-1" in page.told.content
    assert page.track.arc is before


def test_what_no_page_offers_is_said_on_the_page(page):
    before = chosen(page, 3.0)
    for control in (page.controller, page.mode, page.noise):
        usual, control._impl.value = control.value, "![x](/etc/passwd)<img src=x onerror=alert(1)>"
        page._simulate()
        control._impl.value = usual
        assert "unknown choice" in page.told.content
        assert not re.search(
            r"(?<!\\)[<\[]", page.told.content
        )  # which the page would take for HTML
    assert page.track.arc is before


def test_of_what_is_sent_a_page_takes_what_pages_send():
    from msgspec.msgpack import encode

    def usual(**message):
        return viewing._is_usual(encode(message))

    own = {"type": "GuiUpdateMessage", "uuid": "1"}
    turn, place = [1.0, 0.0, 0.0, 0], [1, 2, 3]
    assert all(usual(**own, updates={"value": v}) for v in (True, 1, -0.5, "uniform", place))
    wrong = (
        np.nan,
        -np.inf,
        1e300,
        None,
        {},
        [],
        [1.0],
        [np.nan] * 3,
        ["a"] * 3,
        [place] * 3,
        "a" * 501,
    )
    assert not any(usual(**own, updates={"value": v}) for v in wrong)
    for updates in ({"removed": True}, {"props": 1}, {"value": 1, "props": 1}, {}, [], 1, "value"):
        assert not usual(**own, updates=updates)
    moved = {"type": "TransformControlsUpdateMessage", "name": "start", "owner": ""}
    assert usual(**moved, wxyz=turn, position=place)
    assert not usual(**moved, wxyz=turn, position=turn)
    assert not usual(type="ShareUrlRequest")  # it would make the page public
    for content in (b"", b"\x91" * 100_000, "text", encode([1]), encode({"type": []}), encode({})):
        assert not viewing._is_usual(content)
