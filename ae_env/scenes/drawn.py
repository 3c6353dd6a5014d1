"""Scenes that are drawn when they are first looked at, each on its own."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, overload

from ae_env.scenes.scene import Scene
from ae_env.scenes.stored import rounded, store_scenes
from simulator.utils.compute import parallel_ranges, progress_bar

logger = logging.getLogger(__name__)
#: So many at once are said to be drawn; fewer take no time to speak of.
_MANY = 64


@dataclass(frozen=True)
class SceneSource:
    """Scenes that are made together.

    Args:
        scene_ids: Their names.
        make: Makes them, always the same ones.
    """

    scene_ids: tuple[str, ...]
    make: Callable[[], Iterable[Scene]]


class DrawnScenes(Sequence[Scene]):
    """A list of scenes whose names are known, and which are drawn when they are first needed.

    The first is drawn at once, so that what cannot be drawn is an error here; one that is asked
    for by its index is drawn with those of its source; and all are, where they are looked at in
    turn. When the last one is there they are stored for the next process. Each is the same
    whenever it is drawn. A pickled copy is a list.

    Args:
        name: What they are, in messages.
        sources: Where they come from, in order.
        key: Under which they are stored (`ae_env.scenes.stored`).
    """

    def __init__(self, name: str, sources: Sequence[SceneSource], key: str) -> None:
        self._name, self._sources, self._key = name, sources, key
        self.scene_ids = tuple(one for source in sources for one in source.scene_ids)
        # Which source each scene is of, and its place there.
        self._places = [
            (number, place)
            for number, source in enumerate(sources)
            for place in range(len(source.scene_ids))
        ]
        self._drawn: dict[int, list[Scene]] = {}  # by source
        self._stored = False
        if self.scene_ids:
            self.draw([0])

    def __len__(self) -> int:
        return len(self.scene_ids)

    @overload
    def __getitem__(self, index: int) -> Scene: ...
    @overload
    def __getitem__(self, index: slice) -> list[Scene]: ...
    def __getitem__(self, index: Any) -> Any:
        places = range(len(self))[index]
        if isinstance(places, range):
            self.draw(places)
            return [self._scene(place) for place in places]
        self.draw([places])
        return self._scene(places)

    def __iter__(self) -> Iterator[Scene]:
        self.draw(range(len(self)))
        return (self._scene(place) for place in range(len(self)))

    def __reduce__(self) -> tuple[Any, ...]:
        return list, (list(self),)

    def _scene(self, index: int) -> Scene:
        number, within = self._places[index]
        return self._drawn[number][within]

    def draw(self, indices: Iterable[int]) -> None:
        """Draws those of `indices` that are not there yet, on as many threads as torch may use."""
        wanted = {self._places[index][0] for index in indices}
        missing = sorted(wanted.difference(self._drawn))
        if not missing:
            return
        many = len(missing) >= _MANY
        if many:
            logger.warning("drawing %s, once for this camera and resolution", self._name)
        with progress_bar("drawing scenes", len(missing) if many else 0) as advance:

            def draw_some(first: int, last: int) -> None:
                for number in missing[first:last]:
                    scenes = [rounded(scene) for scene in self._sources[number].make()]
                    self._drawn.setdefault(number, scenes)
                    advance()

            parallel_ranges(draw_some, len(missing))
        if len(self._drawn) == len(self._sources) and not self._stored:
            self._stored = True
            store_scenes(self._key, list(self))
