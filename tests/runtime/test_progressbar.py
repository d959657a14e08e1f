from cbe_runtime import progressbar


def test_short_work_draws_nothing(capsys):
    assert list(progressbar.track(range(5), "work", 5)) == list(range(5))
    assert capsys.readouterr().err == ""


def test_long_work_draws_how_far_it_is(capsys, monkeypatch):
    seconds = iter(range(100))
    monkeypatch.setattr(progressbar.time, "monotonic", lambda: next(seconds))
    assert list(progressbar.track(range(6), "work", 6)) == list(range(6))
    assert "work [##############################] 6/6\n" in capsys.readouterr().err
