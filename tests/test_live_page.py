"""The page of a live session: its model, two viewers of NiceGUI's own, and a session that ends."""

import asyncio
import math
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from unittest.mock import AsyncMock

import numpy as np
import pytest

from drake_safety.live.panel import HISTORY_S, LivePanel, Slider, Status

WITHIN_S = 120


@pytest.fixture
def panel():
    panel = LivePanel(title="a robot", threshold=0.3)
    panel.buttons |= {"Stop": "Escape", "Throw": "Space"}
    panel.sliders["mass [kg]"] = Slider(1.0, 5.0, 0.5, 3.0)
    panel.status = Status("safe", note="a remark", tone="safe")
    panel.show_belief(0.75, np.array([0.7, 0.1, 0.2]), 0.0)
    return panel


def test_a_click_counts_once(panel):
    assert not panel.take_click("Throw")
    panel.click("Throw")
    panel.click("Throw")
    assert panel.take_click("Throw")
    assert not panel.take_click("Throw")


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf, 1e308, None, "2", [2.0]])
def test_what_a_page_sends_stays_within_the_range_of_its_slider(panel, value):
    panel.set_value("mass [kg]", value)
    assert 1.0 <= panel.sliders["mass [kg]"].value <= 5.0
    panel.set_value("mass [kg]", 2)
    assert panel.sliders["mass [kg]"].value == 2.0


def test_the_curve_is_bounded_and_ends_now(panel):
    for time_s in np.arange(1, 1000) * 0.04:
        panel.show_belief(1.5, np.full(3, np.nan), time_s)
    curve = panel.curve()
    assert curve[-1] == (0.0, 1.0)
    assert -HISTORY_S <= curve[0][0] < -HISTORY_S + 0.05
    assert len(curve) <= HISTORY_S / 0.04 + 2
    assert panel.belief == (0.0, 0.0, 1.0)
    panel.history.clear()
    assert panel.curve() == []


def test_two_viewers_see_and_control_the_same(panel, recwarn):
    testing = pytest.importorskip("nicegui.testing")
    from nicegui import ui

    from drake_safety.live.page import build_page

    async def view():
        async with testing.user_simulation(lambda: build_page(panel)) as first:
            second = testing.User(first.http_client)
            for user in (first, second):
                await user.open("/")
                for text in ("safe", "probability 0.75", "a remark", "unsafe 10%"):
                    await user.should_see(text)
            first.find(kind=ui.slider).elements.pop().set_value(4.0)
            await second.should_see("4")
            second.find("Throw").click()
            await asyncio.sleep(0.1)
            assert panel.take_click("Throw")
            panel.stop()
            for user in (first, second):
                await user.should_see("The simulation has ended.")
                await user.should_not_see("probability 0.75")

    asyncio.run(view())


HERE, ALL = "127.0.0.1", "0.0.0.0"


@pytest.mark.parametrize(
    ("host", "name", "origin", "is_answered"),
    [
        (HERE, "127.0.0.1:7000", "http://127.0.0.1:7000", True),
        (HERE, "LocalHost:8000", "http://localhost:8000", True),  # As through SSH.
        (HERE, "127.0.0.1.evil.example:7000", None, False),
        (HERE, "evil.example", "http://evil.example", False),
        (HERE, "192.0.2.1:7000", None, False),
        (HERE, "127.0.0.1:7000", "http://evil.example", False),
        (HERE, "127.0.0.1:7000", "http://127.0.0.1:9000", False),
        (ALL, "192.0.2.1:7000", "http://192.0.2.1:7000", True),
        (ALL, f"{socket.gethostname()}:7000", None, True),
        (ALL, "192.0.2.1:7000", "http://evil.example", False),
    ],
)
def test_only_requests_of_its_own_page_are_answered(host, name, origin, is_answered):
    pytest.importorskip("nicegui")
    from drake_safety.live.page import _only_own

    application, send = AsyncMock(), AsyncMock()

    own = _only_own(application, host)
    headers = {"host": name} | ({} if origin is None else {"origin": origin})
    raw = [(name.encode(), value.encode()) for name, value in headers.items()]
    for kind in ("http", "websocket", "lifespan"):
        asyncio.run(own({"type": kind, "headers": raw, "extensions": {}}, None, send))
    reached = [call.args[0]["type"] for call in application.call_args_list]
    assert reached == (["http", "websocket", "lifespan"] if is_answered else ["lifespan"])
    answers = [call.args[0] for call in send.call_args_list]
    refused = ["http.response.start", "http.response.body", "websocket.close"]
    assert [answer["type"] for answer in answers] == ([] if is_answered else refused)
    assert is_answered or answers[0]["status"] == 403


def answer_to(address, **headers):
    """The status of an answer and its text."""
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=WITHIN_S) as answer:
            return answer.status, answer.read().decode(errors="replace")
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


@pytest.fixture
def playing(tmp_path):
    """A command that plays, the address of its page, and the file that it records."""
    pytest.importorskip("nicegui")
    code = "from drake_safety.cli import main; main()"
    command = [sys.executable, "-u", "-c", code, "play", "laikago_balancing"]
    command += ["--mcap", str(tmp_path / "play.mcap")]
    # NiceGUI serves otherwise in a test.
    environment = {key: text for key, text in os.environ.items() if "PYTEST" not in key}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    printed = ""
    while "live at" not in printed:
        line = process.stdout.readline()
        assert line, printed
        printed += line
    address = re.search(r"http://\S+", printed[printed.index("live at") :])[0]
    yield process, address, tmp_path / "play.mcap"
    process.kill()
    process.wait()
    process.stdout.close()


def check_scene(address):
    """Checks that the scene is served at the page's port alone, and that no message ends it."""
    client = pytest.importorskip("websockets.sync.client")
    status, scene = answer_to(address)
    assert status == 200 and "MeshCat" in scene
    for path in re.findall(r'src="(\S+)"', scene):
        assert answer_to(address + path)[0] == 200
    place = address.replace("http", "ws")
    with pytest.raises(Exception, match="403"), client.connect(place, origin="http://evil.example"):
        pass
    for message in (b"", "", b"\xc1", bytes(1000)):
        with client.connect(place) as scene:
            assert scene.recv(timeout=WITHIN_S)
            scene.send(message)
            for _ in range(20):  # The robot moves.
                assert scene.recv(timeout=WITHIN_S)


@pytest.mark.slow
def test_a_page_is_served_without_other_hosts_until_a_signal(playing):
    from mcap.reader import make_reader

    process, address, recorded = playing
    status, page = answer_to(address)
    assert status == 200 and "laikago_balancing" in page
    hosts = set(re.findall(r"(?:src|href|url)[=(]\W{0,2}(https?://[^/\"'\\]+)", page))
    assert hosts <= {address}
    assert answer_to(address, Host="evil.example")[0] == 403
    check_scene(f"{address}/scene/")
    process.send_signal(signal.SIGTERM)  # As Ctrl-C, by the same handler.
    process.communicate(timeout=WITHIN_S)
    assert process.returncode == 0
    with recorded.open("rb") as file:
        assert make_reader(file).get_summary().statistics.message_end_time > 100_000_000
