"""The worlds that agents are trained in, and the sizes of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from ae_env.options import EnvOptions
from ae_env.scenes import Scene, load_scenes
from ae_env.scenes.load import simulate_source_raw
from ae_env.scenes.polyhaven import list_assets
from ae_env.scenes.scene import Crop, Split
from agents.evaluation.plan import groups_in_turn
from benchmarks.fidelity.models import weights
from simulator import CameraProfile

#: Range of the ISO of the sources that the claim about noisy ones is about.
HIGH_ISO = (1600.0, 6400.0)
#: Packed pixels a side, of every training and every table.
RESOLUTION = 64
#: EXP has no network: exposure ratio and noise level function only. The weights of `PAPER` do not
#: come with the package.
TRUTH, EXP, PAPER = "truth", "EXP", "paper"
SIMULATORS = (EXP, "nano", "compact", "large", PAPER)
#: Bundled scenes and views of real places together.
BOTH = "both"


# -- scenes ---------------------------------------------------------------------------------------


def scenes_of(
    name: str, crop: Crop, split: Split, camera: CameraProfile, resolution: int | None
) -> list[Scene]:
    names = ("bundled", "polyhaven") if name == BOTH else (name,)
    common: dict[str, Any] = {"camera": camera, "resolution": resolution, "crop": crop}
    return [scene for one in names for scene in load_scenes(one, split, **common)]


def at_high_iso(
    name: str, split: Split, camera: CameraProfile, resolution: int | None
) -> list[Scene]:
    """Scenes of a set, each photographed once at an ISO of 1600 to 6400, drawn by its name.

    What `source="raw"` makes of them but for the ISO: exposure and noise are drawn alike.
    """
    scenes = scenes_of(name, "box", split, camera, resolution)
    return [simulate_source_raw(scene, iso_range=HIGH_ISO) for scene in scenes]


#: What the environment's `scenes` names, as ``"benchmarks.transfer.worlds:high_iso_both_box"``.
both_box: Callable[..., list[Scene]] = partial(scenes_of, BOTH, "box")
high_iso_both_box: Callable[..., list[Scene]] = partial(at_high_iso, BOTH)
high_iso_bundled_box: Callable[..., list[Scene]] = partial(at_high_iso, "bundled")
high_iso_small_box: Callable[..., list[Scene]] = partial(at_high_iso, "bundled:small")


# -- worlds ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class World:
    """What an agent is trained in."""

    simulator: str
    high_iso: bool = False

    @property
    def name(self) -> str:
        """In tables and file names."""
        return f"{self.simulator}-iso1600" if self.high_iso else self.simulator

    def options(self, scenes: str) -> dict[str, Any]:
        """Arguments of the environment that differ between the worlds, of a set of scenes."""
        if self.high_iso:
            scenes = f"{__name__}:high_iso_{scenes.split(':')[-1]}_box"
        elif scenes == BOTH:
            scenes = f"{__name__}:{BOTH}_box"
        if self.simulator == TRUTH:
            return {"scenes": scenes, "source": "light"}
        return {"scenes": scenes, "source": "raw", "simulator": simulator_argument(self.simulator)}


def simulator_argument(name: str) -> str | None:
    """The environment's argument for a simulator's name."""
    if name == EXP:
        return None
    return str(weights(name))


#: All of them by name; the truth comes first: the others are compared with it.
_SOURCES = (World(TRUTH), World(EXP), World("compact"), World("large"), World(PAPER))
_NOISY = (World(EXP, high_iso=True), World("compact", high_iso=True))
WORLDS: dict[str, World] = {world.name: world for world in (*_SOURCES, *_NOISY)}


def has_weights(name: str) -> bool:
    """Whether the networks of a simulator, or of a world's, are there."""
    return not name.startswith(PAPER) or weights(PAPER) is not None


# -- sizes of a run -------------------------------------------------------------------------------


@dataclass(frozen=True)
class TableSet:
    """Score tables that are predicted."""

    scorer: str = "balanced"
    scenes: int = 32
    simulators: tuple[str, ...] = SIMULATORS
    isos: tuple[int, ...] = (100, 400, 1600, 6400)
    evs: tuple[int, ...] = (-3, -1, 0, 1, 3)
    crops: tuple[Crop, ...] = ("box", "native")


#: Tables of a scorer that looks at the captures themselves, noise and all: 0.3 s each.
SEEN = TableSet("fidelity", 10, (EXP, "compact", PAPER), (1600, 6400), (-1, 0, 1))


@dataclass(frozen=True)
class TransferPlan:
    """How much is trained and measured."""

    scenes: str = BOTH
    worlds: tuple[str, ...] = tuple(WORLDS)
    agents: tuple[str, ...] = ("regression", "ppo")
    seeds: tuple[int, ...] = (0, 1, 2)
    frames: int = 16_384
    episodes: int = 2
    judged_scenes: int | None = None
    scorer: str = "balanced"
    tables: tuple[TableSet, ...] = (TableSet(), SEEN)


QUICK = TransferPlan(
    scenes="bundled:small",
    worlds=(TRUTH, EXP, "compact", "EXP-iso1600", "compact-iso1600"),
    seeds=(0,),
    frames=2048,
    episodes=1,
    judged_scenes=16,
    tables=(
        TableSet(scenes=16, simulators=(EXP, "compact"), isos=(100, 6400), evs=(-3, 0, 3)),
        TableSet("fidelity", 2, (EXP, "compact"), (6400,), (0,), ("native",)),
    ),
)


def training_set(plan: TransferPlan) -> str:
    """The plan's scenes; the bundled ones where it asks for panoramas and there are none."""
    has_panoramas = all(asset.path is not None for asset in list_assets())
    return "bundled" if plan.scenes == BOTH and not has_panoramas else plan.scenes


def held_out(plan: TransferPlan, count: int | None, crop: Crop) -> list[Scene]:
    """`count` test scenes of the truth, kinds and source groups in turn; None for all of them."""
    options = EnvOptions(split="test", resolution=RESOLUTION, crop=crop)
    found = scenes_of(training_set(plan), crop, "test", options.make_camera(), RESOLUTION)
    return groups_in_turn(found, count)
