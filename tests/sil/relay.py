"""A cable between two processes: a TCP relay on loopback that can be cut, or swallow everything."""

import random
import socket
import threading
import time
from collections import deque
from contextlib import suppress

CHUNK = 2**16
POLL_S = 0.005


class Relay:
    """Forwards connections to a port.

    `cut` closes and refuses them, as an unplugged or restarted router does; `swallow` keeps them
    open and forwards nothing, as a network does that silently loses every packet; `heal` ends
    either. Every byte is delayed by `delay_s` and up to `jitter_s` more.
    """

    def __init__(self, target_port, delay_s=0.0, jitter_s=0.0, seed=0):
        self._target = ("127.0.0.1", target_port)
        self._delay_s, self._jitter_s = delay_s, jitter_s
        self._random = random.Random(seed)
        self._lock = threading.Lock()
        self._pairs = []  # (from, to, waiting [(due_s, bytes)])
        self._swallowing = self._cut = False
        self._closed = threading.Event()
        self._listener = None
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self._listen()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def endpoint(self):
        return f"tcp/127.0.0.1:{self.port}"

    def cut(self):
        with self._lock:
            self._cut = True
            self._listener.close()
            self._drop()

    def swallow(self):
        with self._lock:
            self._swallowing = True

    def heal(self):
        """A cable that swallowed packets has lost them: its old connections are of no use."""
        with self._lock:
            if self._swallowing:
                self._drop()
            if self._cut:
                self._listen()
            self._swallowing = self._cut = False

    def close(self):
        self._closed.set()
        self._thread.join()
        with self._lock:
            self._listener.close()
            self._drop()

    def _listen(self):
        self._listener = socket.create_server(("127.0.0.1", self.port), reuse_port=True)
        self._listener.setblocking(False)

    def _drop(self):
        for sink, source, _ in self._pairs:
            for end in (sink, source):
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
                end.close()
        self._pairs.clear()

    def _run(self):
        while not self._closed.wait(POLL_S):
            with self._lock:
                if not self._cut:
                    self._accept()
                if not self._swallowing:
                    self._forward()

    def _accept(self):
        with suppress(BlockingIOError):
            near, _ = self._listener.accept()
            try:
                far = socket.create_connection(self._target, timeout=1.0)
            except OSError:
                near.close()
                return
            for end in (near, far):
                end.setblocking(False)
            self._pairs += [(near, far, deque()), (far, near, deque())]

    def _forward(self):
        now_s = time.monotonic()
        ended = []
        for pair in self._pairs:
            source, sink, waiting = pair
            try:
                while data := source.recv(CHUNK):
                    late_s = self._delay_s + self._random.uniform(0.0, self._jitter_s)
                    due_s = max(now_s + late_s, waiting[-1][0] if waiting else 0.0)
                    waiting.append((due_s, data))
                ended.append(pair)
            except BlockingIOError:
                pass
            except OSError:
                ended.append(pair)
            with suppress(OSError):
                while waiting and waiting[0][0] <= now_s:
                    sink.setblocking(True)
                    sink.settimeout(1.0)
                    sink.sendall(waiting.popleft()[1])
                    sink.setblocking(False)
        for source, sink, _ in ended:
            for end in (source, sink):
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
                end.close()
            self._pairs = [pair for pair in self._pairs if source not in pair[:2]]
