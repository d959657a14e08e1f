"""Configuration files (TOML), up to the settings that the runtime would start with."""

import random
from pathlib import Path

import zenoh

from cbe_runtime import command_runtime, options
from cbe_runtime.cli import Parser
from cbe_runtime.modelfile import ModelFile

from .harness import SEED
from .mutate import mutants

EXAMPLE = b"""
memory = "route.msgpack"
model = "models"
key_style = "bare"
connect = ["tcp/127.0.0.1:7447", "tcp/10.0.0.2:7447"]
robot = "carrier_1"
domain = 7
lockstep = true
patience = 3.5

[camera]
width = 64
height = 48
fx = 20.5
fy = 20
cx = 32.0
cy = 24.0
model = "fisheye"
distortion = [0.1, 0.0, 0.0, 0.0]

[follower]
fresh_s = 0.25
progress_ticks = 3
"""
HUB = b'listen = ["tcp/127.0.0.1:7447"]\nverbose = true\ntwist = true\nclock = "sim"\n'
TOKENS = b"""
nan inf -inf 1e400 9223372036854775808 0xffffffffffffffffffffffffffff 1979-05-27T07:32:00Z true
false [] {} [[]] {a=1} "" "\\u0000" "\\ud800" "/dev/zero" "-" "--help" '''x''' [camera] [[camera]]
[follower] camera follower help config memory model camera.width follower.fresh_s = . , # \xff
connect listen keys allow_drive one_way_tls domain patience robot width fx distortion fresh_s
"unixsock-stream/x" "tls/127.0.0.1:7447" "tcp/127.0.0.1:99999#a=b" "tcp/[::1]:1"
""".split()


def hostile():
    """Bytes changed anywhere, and lines whose values are others'."""
    changed = mutants([EXAMPLE, HUB], SEED, TOKENS)
    rng = random.Random(SEED)
    files = [EXAMPLE.splitlines(), HUB.splitlines()]
    values = [*TOKENS, *(line.partition(b"=")[2] for file in files for line in file)]
    while True:
        yield next(changed)
        lines = list(rng.choice(files))
        for _ in range(rng.choice((1, 1, 2))):
            at = rng.randrange(len(lines))
            key, equals, value = lines[at].partition(b"=")
            token = rng.choice(values)
            lines[at] = rng.choice((b"", key + equals + token, token + equals + value))
        yield b"\n".join(lines)


def attacks():
    long = b'"' + b"x" * 5_000 + b'"'
    for key in (b"memory", b"model", b"camera", b"connect", b"robot", b"domain", b"keys", b"clock"):
        yield key + b" = " + long
        yield key + b" = [" + b", ".join([long] * 10) + b"]"
        yield key + b" = 0x" + b"f" * 50_000
        yield key + b" = " + b"9" * 50_000
        yield key + b" = {" + key + b" = 1}"
    for table in (b"camera", b"follower"):
        yield table + b" = 3"
        yield b"[[" + table + b"]]"
        yield b"[" + table + b"]\n" + b"fx = " + b"9" * 4_000
        yield b"[" + table + b"]\n" + b'"' + b"k" * 60_000 + b'" = 1'
    yield b"a = " + b"[" * 60_000
    yield b"a = " + b"{a=" * 20_000
    yield b".".join([b"a"] * 30_000) + b" = 1"
    yield b"\n".join(b".".join([b"k%d" % n, *[b"a"] * 99]) + b" = 1" for n in range(300))
    yield b"a = 1\n" * 10_000
    yield b"".join(b"k%d = 1\n" % n for n in range(6_000))
    yield b"\xef\xbb\xbf" + EXAMPLE
    yield b"#" * (options.MAX_TOML_BYTES + 1)


def test_hostile_config_is_refused_soon_and_small(fuzzed, tmp_path):
    path = tmp_path / "config.toml"
    parser = Parser(prog="cbe-runtime", allow_abbrev=False)
    parser.add_argument("--verbose", action="store_true")
    command_runtime.add_options(parser)

    def read(data):
        path.write_bytes(data)
        parsed = command_runtime.parse(parser, ["--config", str(path)])
        options.follower_config(parsed.follower, path)
        if parsed.camera_table is not None:
            options.camera_of(parsed.camera_table, path)
        settings = zenoh.Config()
        for key, value in options.link_config(parsed).zenoh_json5().items():
            settings.insert_json5(key, value)
        if parsed.model != Path("models"):
            ModelFile.read(parsed.model / "encoder.onnx")

    report = fuzzed("configs", read, [EXAMPLE, HUB], hostile(), attacks=attacks())
    assert 0 < report.accepted < report.inputs
