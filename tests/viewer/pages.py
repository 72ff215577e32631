"""A page without a browser: what viser's page says and hears, by its wire format."""

import time

import msgspec
import viser
import zstandard
from websockets.sync.client import connect

PATIENCE = 60.0  # seconds: a busy machine is slow


def is_image(message):
    """Whether a message brings a picture; the first of a server takes away that of an earlier one."""
    return message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None


class WirePage:
    """Connects to a site; answers what it is asked, and notes what it is told."""

    def __init__(self, url, origin=None):
        origin = url if origin is None else origin
        address = url.replace("http", "ws", 1)
        self._socket = connect(
            address, origin=origin, subprotocols=[f"viser-v{viser.__version__}"], max_size=None, open_timeout=PATIENCE
        )
        self.heard = []

    def close(self):
        self._socket.close()

    def say(self, kind, **fields):
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look_from(self, position=(0.0, 2.0, -5.0), wxyz=(1.0, 0.0, 0.0, 0.0), fov=0.9, size=(160, 120)):
        fields = {"wxyz": wxyz, "position": position, "fov": fov, "near": 0.01, "far": 1000.0}
        fields |= {"image_width": size[0], "image_height": size[1], "look_at": (0, 0, 0), "up_direction": (0, 1, 0)}
        self.say("ViewerCameraMessage", **fields)

    def listen(self, seconds):
        """Hear what is said in the next message, if it comes in time."""
        try:
            raw = self._socket.recv(timeout=seconds)
        except TimeoutError:
            return
        count = int.from_bytes(raw[8:16], "little")
        inner = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + count]))
        for message in inner["messages"]:
            self.heard.append(message)
            if message["type"] == "LocalStorageGetItemRequestMessage":
                answer = {"value": None, "error": None, "request_uuid": message["request_uuid"]}
                self.say("LocalStorageGetItemResponseMessage", **answer)

    def until(self, condition, since=0):
        """The first message, of those heard since some number of them, for which a condition holds."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            for message in self.heard[since:]:
                if condition(message):
                    return message
            self.listen(0.2)
        raise AssertionError(sorted({message["type"] for message in self.heard[since:]}))

    def rest(self, seconds=1.0):
        """Listen until nothing was said for some time."""
        count = -1
        while count != len(self.heard):
            count = len(self.heard)
            self.listen(seconds)

    def images(self, since=0):
        return [m["rgb_data"] for m in self.heard[since:] if is_image(m)]

    def input(self, label):
        """Number of an input of the panel."""
        return self.until(lambda m: m.get("props", {}).get("label") == label)["uuid"]

    def enter(self, label, value):
        self.say("GuiUpdateMessage", uuid=self.input(label), updates={"value": value})
