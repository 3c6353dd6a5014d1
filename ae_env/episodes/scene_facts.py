"""What episodes must know of their scenes, as columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ae_env.scenes.scene import Scene, SceneSet


class SceneFacts:
    """Facts about n scenes, for whole batches of episodes at once.

    Those of scenes that are drawn on demand are known once `look_at` has been called for them.

    Args:
        scenes: The scenes.
        num_states: Number of exposure states, S.

    Attributes:
        scene_ids: Their names.
        allowed: (n, S) bool, the states that each allows.
        median_speed: (n,) `Scene.median_speed`.
        has_subject: (n,) bool, whether part of it may move on its own.
        own_blur: (n,) `Scene.own_blur` at f/4 [pixel].
        has_map: (n,) bool, whether it has a `Scene.defocus_map`.
        box_factor: (n,) `Scene.box_factor`.

    Raises:
        ValueError: If a scene was made for another number of states.
    """

    def __init__(self, scenes: SceneSet, num_states: int) -> None:
        self._scenes, count = scenes, len(scenes)
        self.allowed = np.ones((count, num_states), bool)
        self.median_speed, self.own_blur = np.zeros((2, count))
        self.has_subject, self.has_map, self._known = np.zeros((3, count), bool)
        self.box_factor = np.ones(count, np.int64)
        self.scene_ids, self._all_known = scenes.scene_ids, False
        self._fill(scenes.loaded)

    def look_at(self, indices: np.ndarray) -> None:
        """Makes the facts about the scenes `indices` known: they are about to be shown."""
        if self._all_known or self._known[indices].all():
            return
        new = np.unique(indices[~self._known[indices]]).tolist()
        self._scenes.load(new)
        self._fill(new)
        self._all_known = bool(self._known.all())

    def _fill(self, indices: Sequence[int]) -> None:
        for index in indices:
            scene = self._scenes[index]
            self.allowed[index] = allowed_states(scene, self.allowed.shape[1])
            self.median_speed[index], self.own_blur[index] = scene.median_speed, scene.own_blur(4.0)
            layout = scene.layout
            self.has_subject[index] = layout is not None and layout.subject is not None
            self.has_map[index] = scene.defocus_map is not None
            self.box_factor[index] = scene.box_factor
            self._known[index] = True


def allowed_states(scene: Scene, num_states: int) -> np.ndarray:
    """(S,) bool: the states that `scene` allows.

    Raises:
        ValueError: If the scene was made for another number of states.
    """
    if scene.allowed is None:
        return np.ones(num_states, bool)
    if len(scene.allowed) != num_states:
        raise ValueError(
            f"`allowed` of scene {scene.scene_id!r} (length {len(scene.allowed)}) must have one "
            f"entry for each of the {num_states} states of `grid`"
        )
    return scene.allowed
