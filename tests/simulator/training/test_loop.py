"""The loop of one stage: budgets, schedule, and a state that survives a kill at any moment."""

from __future__ import annotations

import functools
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from simulator.training import loop
from simulator.training.config import SimulatorConfig, StageConfig
from simulator.training.loop import Clock, learning_rate, train_stage
from simulator.training.train import make_accelerator
from simulator.utils.checkpoint import Checkpoint

Hook = Callable[[int], None]
STEPS = 12
CONFIG = SimulatorConfig(preset="pc", baseline=StageConfig(steps=1))


class Pairs:
    """Batches of numbers by step; calls `hook` before each."""

    def __init__(self, hook: Hook | None = None, *, broken: int = -1) -> None:
        self.hook, self.broken, self.steps = hook, broken, []

    def batch(self, step: int, size: int, crop: int, *, process: int = 0) -> torch.Tensor:
        assert (size, crop, process) == (3, 16, 0)
        if self.hook is not None:
            self.hook(step)
        self.steps.append(step)
        values = torch.randn(size, 4, generator=torch.Generator().manual_seed(step))
        return values * (math.inf if step == self.broken else 1.0)


class Loss(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.trained, self.frozen = nn.Linear(4, 2), nn.Linear(2, 1)

    def forward(self, batch: torch.Tensor) -> dict[str, torch.Tensor]:
        value = self.frozen(self.trained(batch).tanh() + 0 * batch[:, :2]).square().mean()
        return {"loss": value, "undefined": value.detach() * math.nan}


def run(
    file: Path,
    hook: Hook | None = None,
    *,
    broken: int = -1,
    stage: StageConfig | None = None,
    identity: Any = "one",
    progress: Any = None,
) -> tuple[Loss, Clock, Pairs]:
    made, pairs = Loss(), Pairs(hook, broken=broken)
    clock = train_stage(
        "noise",
        made,
        made.trained,
        pairs,  # type: ignore[arg-type]
        stage or StageConfig(steps=STEPS, batch=3, crop=16, learning_rate=0.05),
        make_accelerator(CONFIG, "cpu", None),
        checkpoint=file,
        identity=identity,
        progress=progress,
    )
    return made, clock, pairs


def same(a: nn.Module, b: nn.Module) -> bool:
    others = b.state_dict()
    return all(torch.equal(value, others[name]) for name, value in a.state_dict().items())


@pytest.fixture
def saving_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "Checkpoint", functools.partial(Checkpoint, interval=-1.0))


def stop_at(step: int) -> Hook:
    def hook(now: int) -> None:
        if now == step:
            raise KeyboardInterrupt

    return hook


def test_it_trains_what_it_shall_and_nothing_else(tmp_path: Path) -> None:
    made, clock, pairs = run(tmp_path / "a")
    assert clock.step == STEPS
    assert pairs.steps == list(range(STEPS))
    new = Loss()
    assert same(made.frozen, new.frozen)
    assert not torch.equal(made.trained.weight, new.trained.weight)
    assert not any(p.requires_grad for p in made.frozen.parameters())


@pytest.mark.parametrize("step", [1, 6, STEPS - 1])
def test_ctrl_c_and_again_ends_where_one_run_ends(tmp_path: Path, step: int) -> None:
    whole, *_ = run(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "part", stop_at(step))
    resumed, clock, pairs = run(tmp_path / "part")
    assert pairs.steps == list(range(step, STEPS))
    assert clock.step == STEPS
    assert same(resumed, whole)


@pytest.mark.usefixtures("saving_every_step")
def test_a_kill_and_again_ends_where_one_run_ends(tmp_path: Path) -> None:
    """What a power cut leaves: the file as it was in the middle of step 7."""

    def copy(step: int) -> None:
        if step == 7:
            shutil.copy(tmp_path / "whole", tmp_path / "left")

    whole, *_ = run(tmp_path / "whole", copy)
    resumed, _, pairs = run(tmp_path / "left")
    assert pairs.steps == list(range(7, STEPS))
    assert same(resumed, whole)


@pytest.mark.usefixtures("saving_every_step")
def test_ctrl_c_within_a_step_leaves_no_half_done_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights that moved without their step being counted would move twice."""
    whole, *_ = run(tmp_path / "whole")
    real = torch.optim.Adam.step
    calls = []

    def step(self, *arguments, **options):
        result = real(self, *arguments, **options)
        calls.append(1)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return result

    with monkeypatch.context() as patch:
        patch.setattr(torch.optim.Adam, "step", step)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "part")
    resumed, _, pairs = run(tmp_path / "part")
    assert pairs.steps == list(range(4, STEPS))
    assert same(resumed, whole)


def test_a_stage_that_is_done_is_not_trained_again(tmp_path: Path) -> None:
    whole, first, _ = run(tmp_path / "a")
    again, clock, pairs = run(tmp_path / "a")
    assert pairs.steps == []
    assert (clock.step, clock.seconds) == (first.step, first.seconds)
    assert same(again, whole)


def test_another_trainings_checkpoint_is_not_taken_over(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run(tmp_path / "a")
    _, _, pairs = run(tmp_path / "a", identity="other")
    assert pairs.steps == list(range(STEPS))
    assert "does not fit, training begins anew" in caplog.text


def test_a_loss_that_is_not_finite_stops_the_training_before_it_does_harm(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"stage 'noise': the loss \(=nan\) must be finite"):
        run(tmp_path / "a", broken=5)
    resumed, _, pairs = run(tmp_path / "a")  # the state on disk is the last good one
    assert pairs.steps == list(range(5, STEPS))
    assert same(resumed, run(tmp_path / "whole")[0])


def test_values_other_than_the_loss_may_be_undefined(tmp_path: Path) -> None:
    calls: list[tuple[float, dict[str, float]]] = []
    run(tmp_path / "a", progress=lambda share, values: calls.append((share, dict(values))))
    ((share, values),) = calls  # twelve steps: only at the end
    assert share == 1.0
    assert list(values) == ["loss"]
    assert math.isfinite(values["loss"])


# Budgets


class Watch:
    """Stands for both clocks of the machine."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.cpu, self.wall = 1000.0, 50.0
        monkeypatch.setattr("time.process_time", lambda: self.cpu)
        monkeypatch.setattr(loop.time, "monotonic", lambda: self.wall)


@pytest.mark.parametrize("on_cpu", [True, False])
def test_minutes_count_work_on_a_cpu_and_the_wall_clock_elsewhere(
    on_cpu: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = Watch(monkeypatch)
    clock = Clock(StageConfig(minutes=2), on_cpu=on_cpu)
    clock.start()
    watch.cpu, watch.wall = 1030.0, 140.0  # 30 s of work in 90 s
    clock.tick()
    assert clock.seconds == (30.0 if on_cpu else 90.0)
    assert clock.share == (0.25 if on_cpu else 0.75)
    watch.cpu = watch.wall = 1e6
    clock.tick()
    assert (clock.step, clock.share) == (2, 1.0)


def test_time_before_a_restart_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = Watch(monkeypatch)
    first = Clock(StageConfig(minutes=1), on_cpu=True)
    first.start()
    watch.cpu += 15
    first.tick()
    watch.cpu += 1000  # the machine was off
    second = Clock(StageConfig(minutes=1), on_cpu=True)
    second.load_state_dict(first.state_dict())
    second.start()
    watch.cpu += 30
    second.tick()
    assert (second.step, second.seconds, second.share) == (2, 45.0, 0.75)


def test_a_stage_ends_with_its_minutes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step takes 7 s here, a minute nine steps; stopped after four, five are left."""
    watch = Watch(monkeypatch)

    def second(step: int) -> None:
        watch.cpu += 7.0

    def stopped(step: int) -> None:
        stop_at(4)(step)
        second(step)

    stage = StageConfig(minutes=1, batch=3, crop=16)
    whole, clock, _ = run(tmp_path / "whole", second, stage=stage)
    assert (clock.step, clock.seconds) == (9, 63.0)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "part", stopped, stage=stage)
    resumed, clock, pairs = run(tmp_path / "part", second, stage=stage)
    assert pairs.steps == [4, 5, 6, 7, 8]
    assert clock.seconds == 63.0
    assert same(resumed, whole)


def test_one_cycle() -> None:
    """Rises to the peak at 5 %, is half of it in the middle of the cosine, ends at 0."""
    shares = [i / 1000 for i in range(1001)]
    rates = [learning_rate(share, 2.0) for share in shares]
    assert rates[50] == max(rates) == pytest.approx(2.0)
    assert rates[25] == pytest.approx(1.0)
    assert rates[525] == pytest.approx(1.0)
    assert rates[-1] == 0.0
    assert rates[0] > 0  # the first step is not lost
    assert rates[:51] == sorted(rates[:51])
    assert rates[50:] == sorted(rates[50:], reverse=True)


def test_the_schedule_reaches_the_optimiser(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = torch.optim.Adam.step
    rates = []

    def step(self, *arguments, **options):
        rates.append(self.param_groups[0]["lr"])
        return real(self, *arguments, **options)

    monkeypatch.setattr(torch.optim.Adam, "step", step)
    run(tmp_path / "a")
    assert rates == [learning_rate(i / STEPS, 0.05) for i in range(STEPS)]
