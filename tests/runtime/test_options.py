"""Options from a TOML file and from the command line."""

import pytest

from cbe.errors import ConfigError
from cbe_runtime import cli, command_runtime, options


def started(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    parser = cli.Parser(prog="cbe-runtime", allow_abbrev=False)
    command_runtime.add_options(parser)
    parsed = command_runtime.parse(parser, ["--config", str(path)])
    if parsed.camera_table is not None:
        options.camera_of(parsed.camera_table, path)
    options.link_config(parsed)
    return options.follower_config(parsed.follower, path)


def test_file_sets_options_and_tables(tmp_path):
    config = started(tmp_path / "c.toml", "domain = 3\n[follower]\nfresh_s = 0.2\n")
    assert config.fresh_s == 0.2


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("help = true", "no option that a file may hold"),
        ('config = "c.toml"', "no option that a file may hold"),
        ('"" = true', "no option that a file may hold"),
        ("nonsense = 1", "--nonsense"),
        ('memory = "a\\u0000b"', "memory holds nothing"),
        ("patience = nan", "patience holds nothing"),
        ("patience = 1e400", "patience holds nothing"),
        ("domain = 1" + "0" * 4000, "domain holds nothing"),
        ("domain = 0x" + "f" * 5000, "domain holds nothing"),
        ("domain = 1979-05-27", "domain holds nothing"),
        ("domain = 300", "domain must be"),
        (f'keys = "{"k" * 300}"', "no folder"),
        ("connect = [" + '"tcp/localhost:1",' * 300 + "]", "300 values"),
        ("follower = 3", "must be a table"),
        ("[[camera]]", "must be a table"),
        ("[follower]\nfresh_s = nan", "positive, finite"),
        ("[follower]\nfresh_s = -1", "positive, finite"),
        ("[follower]\nfresh_s = true", "positive, finite"),
        ("[follower]\nprogress_ticks = 1.5", "progress_ticks"),
        ("[follower]\nother = 1", "unknown"),
        ("[camera]\nfx = 1" + "0" * 400, "no usable camera"),
        ("a = " + "[" * 5000, "no TOML"),
        ("a = [", "no TOML"),
        (b"\xff", "no TOML"),
        ("a" + ".a" * 101 + " = 1", "dots"),
        ("#" * (options.MAX_TOML_BYTES + 1), "more than"),
    ],
)
def test_file_that_makes_no_sense_is_refused_with_the_reason(tmp_path, text, reason):
    with pytest.raises(ConfigError, match=reason):
        started(tmp_path / "c.toml", text)


def test_unknown_option_is_refused_with_exit_code_2(capsys):
    assert cli.runtime_main(["--nonsense"]) == 2
    assert "--nonsense; see cbe-runtime --help" in capsys.readouterr().err
