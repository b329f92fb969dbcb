"""The page of a live session: Meshcat's scene, and beside it Γ, belief, state and controls."""

import asyncio
import contextlib
import math
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, MutableMapping
from importlib.resources import files
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

from aiohttp import ClientSession
from nicegui import app, ui
from nicegui.server import Server

from drake_safety.live.panel import COLOURS, HISTORY_S, LivePanel

_PERIOD_S = 0.1  # Between updates of a page.
_SCENE = "/scene"  # Path of the scene on the page's server.
_FAREWELL_S = 1.0  # From the end of a session to that of its page, so that the page shows it.
_WITHIN_S = 20.0  # For the server to start, and to stop.
_Message = MutableMapping[str, Any]  # ASGI, the interface of servers and applications.
_Application = Callable[[_Message, Any, Any], Awaitable[None]]
_BELIEF = {"safe": "safe", "unsafe": "unsafe", "unknown": "don't know"}
_KEYS = {"Escape": "Esc", "ArrowUp": "↑", "ArrowDown": "↓", "ArrowLeft": "←", "ArrowRight": "→"}


@contextlib.contextmanager
def serve_page(panel: LivePanel, *, host: str, port: int, scene_url: str) -> Iterator[None]:
    """Serves the page, with the scene of a Meshcat, in a thread; one page in a process.

    It answers requests for ``host`` and this machine only, and none of other pages, which could
    read it or use its controls.
    """
    app.add_middleware(_only_own, host=host)
    app.mount(_SCENE, _forward(scene_url))
    options: Any = {"title": panel.title, "host": host, "port": port, "show": False}
    options |= {"reload": False, "tailwind": False, "binding_refresh_interval": None}
    options |= {"reconnect_timeout": 10.0, "timeout_graceful_shutdown": 1}
    options["show_welcome_message"] = False
    built = (lambda: build_page(panel),)
    thread = threading.Thread(target=ui.run, args=built, kwargs=options, daemon=True)
    thread.start()
    end = time.monotonic() + _WITHIN_S
    while not (app.is_started and Server.instance.started):
        if not thread.is_alive() or time.monotonic() > end:
            raise ValueError(f"no page can be served at {host}:{port}")
        time.sleep(0.02)
    try:
        yield
    finally:
        panel.stop()
        time.sleep(_FAREWELL_S)
        app.shutdown()
        thread.join(_WITHIN_S)


def _only_own(application: _Application, host: str) -> _Application:
    """Answers requests that name this server (against DNS rebinding), and only its own pages."""
    known = {"127.0.0.1", "::1", "localhost", host.lower()}
    # At all addresses of this machine, which cannot be forged as names can.
    if is_for_all := host in ("0.0.0.0", "::"):
        known.add(socket.gethostname().lower())

    def is_own(headers: dict[bytes, bytes]) -> bool:
        names = (headers.get(key, b"") for key in (b"host", b"origin"))
        server, page = (name.decode("latin-1").lower() for name in names)
        with contextlib.suppress(ValueError):
            name = urlsplit(f"//{server}").hostname or ""
            if name in known or (is_for_all and ip_address(name)):
                return urlsplit(page or f"//{server}").netloc == server
        return False

    async def answer(scope: _Message, receive: Any, send: Any) -> None:
        if scope["type"] not in ("http", "websocket") or is_own(dict(scope["headers"])):
            await application(scope, receive, send)
        elif scope["type"] == "http":
            await _answer(send, 403, b"not served to other hosts or pages")
        else:
            await send({"type": "websocket.close"})  # Before it was accepted: 403.

    return answer


def _forward(url: str) -> _Application:
    """Serves Meshcat's scene; nothing that a browser sends reaches Meshcat.

    Meshcat itself answers every page, and one message that is not its own ends it.
    """

    async def forward(scope: _Message, receive: Any, send: Any) -> None:
        async with ClientSession() as session:
            if scope["type"] == "http":
                path = scope["path"].removeprefix(_SCENE)
                async with session.get(url + path) as reply:
                    kind = reply.headers.get("content-type", "")
                    await _answer(send, reply.status, await reply.read(), kind)
                return
            async with session.ws_connect(f"{url}/", max_msg_size=0) as scene:

                async def wait_until_it_leaves() -> None:
                    while (await receive())["type"] != "websocket.disconnect":
                        pass
                    await scene.close()

                await send({"type": "websocket.accept"})
                waiting = asyncio.create_task(wait_until_it_leaves())
                with contextlib.suppress(OSError):  # It has left.
                    async for message in scene:
                        await send({"type": "websocket.send", "bytes": message.data})
                waiting.cancel()

    return forward


async def _answer(send: Any, status: int, body: bytes, kind: str = "text/plain") -> None:
    headers = [(b"content-type", kind.encode())] if kind else []
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def build_page(panel: LivePanel) -> None:
    """Builds the page of a viewer."""
    here = files(__package__)
    css, script = (here.joinpath(f"page.{kind}").read_text("utf-8") for kind in ("css", "js"))
    tones = " ".join(f"--{name}: {_css(name)};" for name in COLOURS)
    ui.colors(primary=_css("safe"))
    ui.add_css(f":root {{ {tones} }}\n{css}")
    ui.add_head_html(f"<script>{script}</script>")
    with ui.element().classes("scene"):
        ui.element("iframe").props(f'src="{_SCENE}/?reconnect_ms=-1" title="scene"')
        with ui.element().classes("veil"):
            ui.label("stopped").classes("live")
            ui.label("disconnected").classes("lost")
    with ui.element().classes("panel"):
        for build in (_build_readings, _build_controls):
            update = build(panel)
            update()
            ui.timer(_PERIOD_S, update)


def _build_readings(panel: LivePanel) -> Callable[[], None]:
    """Builds text, probability, belief and curve; returns what updates them."""
    with ui.element().classes("status") as box:
        with ui.element().classes("line"):
            state = ui.label().classes("state live")
            ui.label("disconnected").classes("state lost")
            probability = ui.label().classes("probability live")
        cause = ui.label().classes("live")
        note = ui.label().classes("live")
        ui.label("The server of this page does not answer.").classes("lost")
    with ui.element().classes("bar"):
        parts = [ui.element().style(f"background: var(--{key})") for key in _BELIEF]
    with ui.element().classes("line"):
        shares = [ui.label().classes("share").style(f"--colour: var(--{key})") for key in _BELIEF]
    chart = ui.echart(_chart_options(panel.threshold)).classes("chart")
    body = ui.query("body")  # Now: when the session ends, a browser may be too late to load it.

    def update() -> None:
        # Only differences are sent.
        status = panel.status
        state.set_text(status.state)
        is_known = math.isfinite(panel.probability) and not panel.is_stopped
        probability.set_text(f"probability {panel.probability:.2f}" if is_known else "")
        cause.set_text(status.cause.replace("_", " "))
        note.set_text(status.note)
        box.style(f"background: var(--{status.tone})")
        for i, name in enumerate(_BELIEF.values()):
            parts[i].style(f"flex: {panel.belief[i]:.2f}")
            shares[i].set_text(f"{name} {panel.belief[i]:.0%}")
        series, curve = chart.options["series"][0], panel.curve()
        if curve != series["data"]:
            series["data"] = curve
            chart.update()
        if panel.is_stopped:
            body.classes("stopped")

    return update


def _build_controls(panel: LivePanel) -> Callable[[], None]:
    """Builds sliders and buttons; returns what moves the sliders as other viewers did."""
    numbers = {}
    with ui.element().classes("sliders"):
        for name, slider in panel.sliders.items():
            ui.label(name)
            moved = ui.slider(min=slider.low, max=slider.high, step=slider.step)
            moved.on_value_change(lambda event, name=name: panel.set_value(name, event.value))
            numbers[name] = moved, ui.label().classes("number")
    with ui.element().classes("buttons"):
        # The first one, added by every session, ends it.
        stop, *others = panel.buttons
        for name in (*others, stop):
            key = panel.buttons[name]
            button = ui.button(name, on_click=lambda name=name: panel.click(name))
            with button.props(f'no-caps unelevated data-key="{key}"'):
                ui.label(_KEYS.get(key, key.removeprefix("Key"))).classes("key")

    def update() -> None:
        for name, (slider, number) in numbers.items():
            slider.set_value(panel.sliders[name].value)
            number.set_text(f"{panel.sliders[name].value:g}")

    return update


def _chart_options(threshold: float) -> dict[str, Any]:
    limit: Any = {"silent": True, "symbol": "none", "data": [{"yAxis": threshold}]}
    limit["lineStyle"] = {"color": _css("unsafe"), "type": "solid", "width": 1.5}
    limit["label"] = {"formatter": "threshold {c}", "position": "insideStartTop"}
    curve: Any = {"type": "line", "showSymbol": False, "silent": True, "data": []}
    curve |= {"lineStyle": {"color": _css("safe"), "width": 2.5}, "markLine": limit}
    return {
        "animation": False,
        "grid": {"left": 30, "right": 10, "top": 30, "bottom": 22},
        "title": {"text": "probability over time [s]", "textStyle": {"fontSize": 13}},
        "xAxis": {"type": "value", "min": -HISTORY_S, "max": 0},
        "yAxis": {"type": "value", "min": 0, "max": 1, "interval": 0.5},
        "series": [curve],
    }


def _css(name: str) -> str:
    return "#" + "".join(f"{round(255 * level):02x}" for level in COLOURS[name])
