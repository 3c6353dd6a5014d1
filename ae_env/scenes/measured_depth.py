"""Scenes whose depth was measured: their layout is that of a lens focused at one distance."""

from __future__ import annotations

from ae_env.scenes.scene import Scene
from simulator.camera import CameraProfile
from simulator.capture.prepared_scene import Layout
from simulator.noise.noise_level_function import NoiseLevelFunction
from simulator.reference.camera import ReferenceScene, lens_blur, sample_mosaic
from simulator.training.scenes import depth_photographs
from simulator.utils.files import data_folder

#: Largest circle of confusion of a subject, relative to the largest of the scene.
IN_FOCUS = 0.1


def scene_with_depth(reference: ReferenceScene, camera: CameraProfile) -> Scene:
    """A reference scene for the environment.

    Its layout follows from its depth and its lens: the subject is what is in focus. How large the
    circle of confusion is, is drawn with each episode, as for every scene.

    Args:
        reference: The scene; without depth it has no layout.
        camera: Whose colour filter array samples light at the pitch of the photosites.
    """
    light, k, depth = reference.light, reference.pitch, reference.depth
    layout = None
    if depth is not None:
        distance = reference.lens.focus_distance
        layout = Layout.from_depth(depth, distance, in_focus=IN_FOCUS).averaged(k)
    return Scene(
        scene_id=reference.scene_id,
        group=reference.group,
        kind=reference.kind,
        light=sample_mosaic(lens_blur(light), camera.cfa) if k == 2 else light,
        reference=reference.reference,
        camera=camera,
        nlf=NoiseLevelFunction.zero(),
        illuminance=reference.illuminance,
        white_balance=reference.white_balance,
        source=reference.source,
        sampled=reference.sampled,
        layout=layout,
    )


def depth_scenes(camera: CameraProfile) -> list[Scene]:
    """Photographs with measured depth: ``scenes="ae_env.scenes.measured_depth:depth_scenes"``.

    Each is focused on its front and on its median depth. Cones is among them where ``AE_ENV_DATA``
    has it.

    Args:
        camera: In whose colours light is stated.
    """
    found = depth_photographs(camera, data=data_folder())
    return [scene_with_depth(reference, camera) for reference in found]
