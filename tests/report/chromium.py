"""A headless Chromium that tests drive through the DevTools protocol, over two pipes: no socket, no library."""

import base64
import fcntl
import json
import os
import select
import shutil
import time
from pathlib import Path

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


#: run before every page: what it will still do by itself within a second, so that tests wait no longer than it
WATCH = """(() => {
  const waiting = new Set(), { setTimeout: later, clearTimeout: cancel, requestAnimationFrame: frame } = window;
  window.setTimeout = (act, after = 0, ...given) => {
    const number = later(() => { waiting.delete(number); act(...given); }, after);
    if (after < 1000) waiting.add(number);
    return number;
  };
  window.clearTimeout = (number) => { waiting.delete(number); cancel(number); };
  window.requestAnimationFrame = (act) => {
    const number = frame((now) => { waiting.delete(`frame ${number}`); act(now); });
    waiting.add(`frame ${number}`);
    return number;
  };
  const frames = (count, then) => (count ? frame(() => frames(count - 1, then)) : then());
  window.atRest = (done) => frames(2, () => (waiting.size ? window.atRest(done) : done(1)));
})()"""


def _high(descriptor: int) -> int:
    """The same pipe under a number that the browser's own do not take."""
    high = fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, 10)
    os.close(descriptor)
    return high


class Chromium:
    """One page; ``problems`` holds what the console complained of, ``requests`` every address that was asked for."""

    def __init__(self, profile: Path, *, width: int = 1200, height: int = 1000) -> None:
        to_browser, self._out = map(_high, os.pipe())
        self._in, from_browser = map(_high, os.pipe())
        arguments = [
            BROWSER,
            "--headless=new",
            "--remote-debugging-pipe",
            "--no-sandbox",
            "--disable-gpu",
            "--no-first-run",
            "--disable-dev-shm-usage",
            "--disable-background-networking",
            "--disable-component-update",
            "--force-prefers-reduced-motion",
            "--hide-scrollbars",
            f"--user-data-dir={profile}",
            f"--window-size={width},{height}",
            "about:blank",
        ]
        actions = [(os.POSIX_SPAWN_OPEN, stream, os.devnull, os.O_WRONLY, 0) for stream in (1, 2)]
        # the protocol is spoken on descriptors 3 and 4
        actions += [(os.POSIX_SPAWN_DUP2, to_browser, 3), (os.POSIX_SPAWN_DUP2, from_browser, 4)]
        self._process = os.posix_spawn(BROWSER, arguments, os.environ, file_actions=actions)
        os.close(to_browser)
        os.close(from_browser)
        self._rest, self._number, self._session = b"", 0, None
        self.problems: list[str] = []
        self.requests: list[str] = []
        page = next(t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Page.addScriptToEvaluateOnNewDocument", source=WATCH)
        self._size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.reset()

    def reset(self) -> None:
        """An empty page of the first size in light colours: nothing is left of what was done before."""
        self.call("Emulation.setScriptExecutionDisabled", value=False)
        self.call("Emulation.setDeviceMetricsOverride", **self._size)
        light = [{"name": "prefers-color-scheme", "value": "light"}]
        self.call("Emulation.setEmulatedMedia", media="", features=light)
        self.call("Page.navigate", url="about:blank")
        self.until("document.readyState === 'complete'")
        self.problems.clear()
        self.requests.clear()

    def __enter__(self) -> "Chromium":
        return self

    def __exit__(self, *_: object) -> None:
        self._session = None
        self.call("Browser.close")
        os.waitpid(self._process, 0)
        os.close(self._in)
        os.close(self._out)

    def call(self, method: str, **parameters: object) -> dict:
        number = self._send(method, parameters)
        while True:
            answer = self._next(60)
            if answer is None:
                raise TimeoutError(f"no answer to {method}")
            if answer.get("id") == number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]

    def _send(self, method: str, parameters: dict) -> int:
        """Number under which the answer will come."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        return self._number

    def _next(self, seconds: float) -> dict | None:
        """The next message; events are noted, answers are given back as well."""
        end = time.monotonic() + seconds
        while b"\0" not in self._rest:
            left = end - time.monotonic()
            if left <= 0 or not select.select([self._in], [], [], left)[0]:
                return None
            more = os.read(self._in, 1 << 20)
            if not more:
                raise EOFError("the browser ended")
            self._rest += more
        one, _, self._rest = self._rest.partition(b"\0")
        message = json.loads(one)
        told = message.get("params", {})
        if message.get("method") == "Page.javascriptDialogOpening":
            # a page with unsaved work asks before it is left, and nothing goes on until it is answered: leave
            self._send("Page.handleJavaScriptDialog", {"accept": True})
        elif message.get("method") == "Runtime.exceptionThrown":
            details = told["exceptionDetails"]
            self.problems.append(details.get("exception", {}).get("description", details["text"]))
        elif message.get("method") == "Runtime.consoleAPICalled" and told["type"] in ("error", "warning", "assert"):
            self.problems.append(" ".join(str(one.get("value", one)) for one in told["args"]))
        elif message.get("method") == "Log.entryAdded" and told["entry"]["level"] in ("error", "warning"):
            self.problems.append(told["entry"]["text"])
        elif message.get("method") == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])
        return message

    def open(self, page: Path) -> None:
        self.call("Page.navigate", url=page.as_uri())
        self.until("document.readyState === 'complete'")

    def tell(self, expression: str) -> object:
        """Value of a JavaScript expression; a promise is waited for."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, expression: str, seconds: float = 30) -> None:
        end = time.monotonic() + seconds
        while not self.tell(expression):
            assert time.monotonic() < end, f"never true: {expression}"
            time.sleep(0.05)

    def rest(self) -> None:
        """Wait until the page has drawn, and finely what moved: until no frame and no short timer of it is open."""
        self.tell("new Promise((done) => (window.atRest ?? requestAnimationFrame)(done))")
        self.tell("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def scheme(self, name: str) -> None:
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": name}])
        self.rest()

    def press(self, key: str, *, shift: bool = False) -> None:
        codes = {
            "ArrowLeft": 37,
            "ArrowUp": 38,
            "ArrowRight": 39,
            "ArrowDown": 40,
            "Home": 36,
            "PageDown": 34,
            "PageUp": 33,
            "Enter": 13,
            "Tab": 9,
            "Escape": 27,
        }
        plain = f"Key{key.upper()}" if key.isalpha() else f"Digit{key}"
        about = {
            "key": key,
            "code": key if key in codes else plain,
            "modifiers": 8 if shift else 0,
            "windowsVirtualKeyCode": codes.get(key, ord(key[0].upper())),
        }
        text = {"text": "\r" if key == "Enter" else key} if key == "Enter" or len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown" if text else "rawKeyDown", **about, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", **about)

    def mouse(self, kind: str, x: float, y: float, button: str = "left") -> None:
        held = {"mousePressed": 1, "mouseMoved": 1 if button == "left" else 0}.get(kind, 0)
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=held, clickCount=1)

    def click(self, x: float, y: float) -> None:
        self.mouse("mouseMoved", x, y, "none")
        self.mouse("mousePressed", x, y)
        self.mouse("mouseReleased", x, y)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        self.mouse("mousePressed", *start)
        for step in range(1, 6):
            self.mouse("mouseMoved", *(a + (b - a) * step / 5 for a, b in zip(start, end, strict=True)))
        self.mouse("mouseReleased", *end)
        self.rest()

    def box(self, selector: str) -> dict:
        """Place of an element in the window [CSS px], scrolled into sight."""
        return self.tell(
            f"(() => {{ const e = document.querySelector({selector!r}); e.scrollIntoView({{block: 'center'}});"
            " const {x, y, width, height} = e.getBoundingClientRect(); return {x, y, width, height}; })()"
        )

    def shot(self, clip: dict | None = None) -> bytes:
        """PNG of the window, or of a clip of the whole page [CSS px]."""
        more = {} if clip is None else {"clip": clip | {"scale": 1}, "captureBeyondViewport": True}
        return base64.b64decode(self.call("Page.captureScreenshot", format="png", **more)["data"])
