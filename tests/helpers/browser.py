"""A headless Chromium with software rendering, by its DevTools protocol; tornado comes with Jupyter's kernel."""

from __future__ import annotations

import asyncio
import base64
import json
import re
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from tornado.websocket import websocket_connect

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


class Browser:
    """One page of `width` x `height` pixels. Use it as a context: it ends the program that it starts."""

    def __init__(self, profile: Path, width: int = 1280, height: int = 800) -> None:
        self._profile, self._size = profile, (width, height)
        self._number, self._session = 0, None
        self.events: list[dict[str, Any]] = []
        self._loop = asyncio.new_event_loop()

    def __enter__(self) -> Self:
        assert CHROMIUM is not None
        flags = ("--headless=new", "--no-sandbox", "--remote-debugging-port=0", "--remote-allow-origins=*")
        software = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage")
        self._log = (self._profile / "log").open("w+")
        self._process = subprocess.Popen(
            [CHROMIUM, *flags, *software, f"--user-data-dir={self._profile}", "about:blank"], stderr=self._log
        )
        self.wait_for(lambda: self._address() is not None)
        self._socket = self._loop.run_until_complete(self._connect())
        target = self("Target.createTarget", url="about:blank")["targetId"]
        self._session = self("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self(f"{domain}.enable")
        width, height = self._size
        self("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(20)
        self._log.close()
        self._loop.close()

    def _address(self) -> str | None:
        found = re.search(r"DevTools listening on (ws://\S+)", (self._profile / "log").read_text())
        return found and found[1]

    async def _connect(self) -> Any:
        return await websocket_connect(self._address(), max_message_size=2**28)

    def __call__(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its answer; events in between are kept."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        answer = self._loop.run_until_complete(self._exchange(message))
        assert "error" not in answer, answer["error"]
        return answer["result"]

    async def _exchange(self, message: dict[str, Any]) -> dict[str, Any]:
        await self._socket.write_message(json.dumps(message))
        while True:
            answer = json.loads(await asyncio.wait_for(self._socket.read_message(), 60))
            if answer.get("id") == message["id"]:
                return answer
            self.events.append(answer)

    def wait_for(self, is_so: Any, seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not is_so():
            assert time.monotonic() < end, "timeout"
            time.sleep(0.05)

    def open(self, file: Path) -> None:
        """Open a file and wait until its 3D view is ready or has given up."""
        self("Page.navigate", url=file.resolve().as_uri())
        self.wait_for(lambda: self.js("!!(window.map3d || document.querySelector('.map3d.unavailable'))"))

    def js(self, expression: str) -> Any:
        answer = self("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def picture(self) -> np.ndarray:
        """The page as it is drawn, uint8 [H, W, 3] RGB."""
        code = base64.b64decode(self("Page.captureScreenshot")["data"])
        return cv2.imdecode(np.frombuffer(code, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

    def mouse(self, kind: str, x: float, y: float, held: bool = False) -> None:
        button = {"button": "left", "buttons": int(held), "clickCount": 1}
        self("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, **button)

    def complaints(self) -> list[str]:
        """Exceptions, and errors and warnings on the console."""
        found = []
        for event in self.events:
            method, values = event.get("method"), event.get("params", {})
            if method == "Runtime.exceptionThrown":
                found.append(json.dumps(values)[:500])
            elif method == "Runtime.consoleAPICalled" and values["type"] in ("error", "warning", "assert"):
                found.append(str([part.get("value", part.get("description")) for part in values["args"]])[:500])
            elif method == "Log.entryAdded" and values["entry"]["level"] in ("error", "warning"):
                found.append(values["entry"]["text"][:500])
        return found

    def addresses(self) -> set[str]:
        """Kinds of addresses that the page asked for: `file`, `data`, `blob`."""
        sent = [event for event in self.events if event.get("method") == "Network.requestWillBeSent"]
        return {event["params"]["request"]["url"].split(":")[0] for event in sent}
