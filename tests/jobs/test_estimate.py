"""The estimate of a run leaves out what the run does not repeat."""

from types import SimpleNamespace

from numba.core import event

from gyrostab.jobs import estimate


def test_compiling_does_not_count_as_work(monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(estimate, "time", SimpleNamespace(process_time=lambda: clock.now))
    with estimate._measure_work() as work_s:
        begun = work_s()
        clock.now += 2.0
        with event.trigger_event("numba:compile"):
            clock.now += 10.0
            with event.trigger_event("numba:compile"):  # a function that the first one calls
                clock.now += 30.0
        clock.now += 1.0
        assert work_s() - begun == 3.0
