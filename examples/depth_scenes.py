"""Scenes of one's own: photographs whose depth was measured.

In a clone, `scenes="examples.depth_scenes:depth_scenes"` trains and judges on them. Their layout is
that of a lens focused at one distance: each is focused on its front and on its median depth, and
the subject is what is in focus. How large the circle of confusion is, is drawn with each episode,
as for every scene. Cones is among them where ``AE_ENV_DATA`` has it.
"""

from ae_env.scenes import Scene
from simulator.camera import CameraProfile
from simulator.capture.blurred_frames import Layout
from simulator.reference.reference_camera import lens_blur, sample_mosaic
from simulator.training.scenes import depth_photographs
from simulator.utils.files import data_folder

#: Largest circle of confusion of a subject, relative to the largest of the scene.
IN_FOCUS = 0.1


def depth_scenes(camera: CameraProfile) -> list[Scene]:
    """The scenes in the colours of `camera`."""
    scenes = []
    for found in depth_photographs(camera, data=data_folder()):
        light, k, depth, layout = found.light, found.pitch, found.depth, None
        if depth is not None:
            distance = found.lens.focus_distance
            layout = Layout.from_depth(depth, distance, in_focus=IN_FOCUS).averaged(k)
        scene = Scene.from_array(
            sample_mosaic(lens_blur(light), camera.cfa) if k == 2 else light,
            found.reference,
            camera,
            scene_id=found.scene_id,
            group=found.group,
            kind=found.kind,
            illuminance=found.illuminance,
            white_balance=found.white_balance,
            source=found.source,
            sampled=found.sampled,
            layout=layout,
        )
        scenes.append(scene)
    return scenes
