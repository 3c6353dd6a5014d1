"""Exported agents against those in torch, and a camera that is driven by one."""

import functools
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ae_env.observation import encode_observation, encode_settings
from ae_env.scenes import load_scenes
from agents import PolicyContext, make_policy
from agents.onboard.controller import Controller, ExposureState
from agents.onboard.export import export_agent
from examples import picamera2_ae, simulated_camera
from simulator.camera import get_camera
from tests.ae_env.environments import make_envs

ROOT = Path(__file__).parents[3]

small_envs = functools.partial(make_envs, split="test", max_episode_steps=None, resolution=64)


@pytest.fixture(scope="module")
def context() -> PolicyContext:
    return PolicyContext.from_envs(small_envs(1))


@pytest.fixture(scope="module", params=["regression", "ppo"])
def exported(request, context, tmp_path_factory):
    policy = make_policy(request.param, context)
    return policy, export_agent(policy, tmp_path_factory.mktemp("onnx") / "agent.onnx")


def test_decisions_of_whole_episodes_are_those_of_torch(exported):
    """In light that jumps, so that the memory is kept and forgotten; a batch is not frozen."""
    policy, file = exported
    for num_envs, stops in ((1, 4), (9, -2)):
        envs = small_envs(num_envs, lighting={"kind": "step", "stops": stops, "at": 4})
        controller = Controller(file, num_envs)
        policy.reset(num_envs)
        shown, _ = envs.reset(seed=1)
        for _ in range(9):
            actions = policy.act(shown)
            assert controller.act(**shown).tolist() == actions.tolist()
            if policy.kind == "regression":  # private: the memory rarely decides an action
                np.testing.assert_allclose(controller._light, policy._light, atol=1e-4)
            shown, *_ = envs.step(actions)


def test_it_needs_no_torch(exported):
    code = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r}); import numpy as np;"
        f"from agents.onboard.controller import Controller; c = Controller({str(exported[1])!r});"
        "c.decide(np.full((4, 96, 128), 0.9), c.states[40]); assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_frames_and_settings_are_encoded_as_the_environment_does(exported):
    controller = Controller(exported[1])
    planes = np.random.default_rng(0).uniform(-0.01, 1.0, (4, 64, 64)).astype(np.float32)
    wanted = encode_observation(torch.from_numpy(planes)).numpy()
    difference = controller.encode_frame(planes).astype(int) - wanted
    assert np.abs(difference).max() <= 1  # float64 here, float32 there
    assert (difference != 0).mean() < 1e-3
    blocks = controller.encode_frame(np.repeat(np.repeat(planes, 3, axis=1), 2, axis=2))
    np.testing.assert_array_equal(blocks, controller.encode_frame(planes))
    state = ExposureState(400.0, 1 / 64, 4.0)
    expected = encode_settings(np.array([4.0, 6.0, 7.0]))  # Av, Tv, and Sv: 3.125 * 2**7 = 400
    np.testing.assert_allclose(controller.encode_settings(state), expected, atol=1e-7)


@pytest.mark.parametrize("left_justified", [False, True])  # as on a Raspberry Pi 5
def test_a_camera_with_delays_and_dropped_frames_is_exposed(exported, left_justified):
    """After each jump of 5 EV it settles, at the aperture that it has, where little is clipped."""
    body = get_camera("nikon_z6")
    scenes = load_scenes("bundled:small", "test", camera=body, resolution=64)
    scene = next(scene for scene in scenes if scene.kind == "indoor")
    gains = [2.0 ** (5 * (i >= 20) - 5 * (i >= 40)) for i in range(60)]
    options = {"gains": gains, "dropped": (5, 6, 21, 43), "left_justified": left_justified}
    camera = simulated_camera.SimulatedCamera(scene, body, 4.0, delay=2, **options)
    steps = list(picamera2_ae.run(camera, Controller(exported[1]), 56, 4.0))
    assert {(decision.state.f_number, decision.held) for _, decision in steps} == {(4.0, False)}
    for last, frame in ((17, 19), (36, 39), (55, 59)):  # the last that came through of each light
        (taken, _), (before, _) = steps[last], steps[last - 3]
        assert abs(np.log2(taken.exposure_time / before.exposure_time)) < 0.1
        controls = {"ExposureTime": 1e6 * taken.exposure_time, "AnalogueGain": taken.iso / 100}
        numbers = camera.photograph(frame, controls).mosaic.astype(float)
        numbers /= 2 ** (16 - body.bit_depth) if left_justified else 1
        signal = (numbers.mean() - body.black_level[0]) / (body.white_level - body.black_level[0])
        assert 0.02 < signal < 0.7


def test_order_and_padding_of_a_raw_stream_are_those_of_its_configuration() -> None:
    mosaic = np.array([[1, 2, 5, 6], [3, 4, 7, 8]])
    for order, bits, planes in (("BGGR", 10, (4, 3, 2, 1)), ("GBRG", 8, (3, 4, 1, 2))):
        black, raw = 2**bits // 16, {"format": f"S{order}{bits}", "size": (4, 2)}
        samples = (black * mosaic).astype(np.uint8 if bits == 8 else np.uint16)
        array = np.pad(samples.view(np.uint8), ((0, 0), (0, 4)))  # the stride is longer
        found = picamera2_ae.planes_of(array, raw, [4096] * 4)
        wanted = [black * np.array([[v - 1, v + 3]]) / (2**bits - 1 - black) for v in planes]
        np.testing.assert_allclose(found, wanted)
    for form, words in (("SRGGB12_CSI2P", "SRGGB12_CSI2P"), ("SRGGB16", "2 rows of 9")):
        with pytest.raises(ValueError, match=words):
            picamera2_ae.planes_of(array, {"format": form, "size": (9, 2)}, [4096] * 4)


def test_a_bad_reading_holds_the_last_state_and_is_forgotten(exported):
    """As if that frame had never been: of a frame, a gyro, a focus drive, one camera of two."""
    planes, camera = np.full((4, 64, 64), 0.3, np.float32), Controller(exported[1])
    state = camera.states[37]
    bad, nan = planes.copy(), float("nan")
    bad[2, 5, 5] = nan
    first = camera.decide(None, state)
    assert (first.state, first.held) == (state, True)  # its own state, before the first choice
    good = camera.decide(planes, state)
    for frame, readings in ((None, {}), (bad, {}), (planes, {"defocus": 10**400})):
        held = camera.decide(frame, camera.states[5], **readings)
        assert (held.state, held.held, bool(held.reason)) == (good.state, True, True)
    fresh = Controller(exported[1])
    assert fresh.decide(planes, state) == good
    run = camera._session.run  # as if a weight were NaN
    camera._session = SimpleNamespace(run=lambda *given: [v * nan for v in run(*given)])
    reason = "the network's output is not finite"
    assert camera.decide(0.5 * planes, camera.states[5]) == (good.state, reason)
    camera._session, darker = SimpleNamespace(run=run), 0.25 * planes
    assert camera.decide(darker, state) == fresh.decide(darker, state)
    frames = (planes, None, bad, planes - 0.4, planes, planes)  # black subtracted twice: 3
    several, settings = Controller(exported[1], 6), np.stack([camera.encode_settings(state)] * 6)
    read = [camera.encode_sensors(*pair) for pair in ((1, 1), *[(0.1, 1)] * 3, (nan, 1), (1, nan))]
    raw, readings = np.stack([camera.encode_frame(frame) for frame in frames]), np.stack(read)
    chosen = several.act(raw, settings, readings)
    assert chosen[1:].tolist() == [37] * 5
    reasons = r";no.*;.*finite;.*black;.*speed.*;.*defocus.*"
    assert re.fullmatch(reasons, ";".join(several.reasons))
    again = several.act(np.stack([raw[0]] * 6).astype(np.uint8), settings, readings[[0] * 6])
    assert again.tolist() == [chosen[0]] * 6


def test_a_damaged_card_or_weight_is_named(exported, tmp_path):
    onnx = pytest.importorskip("onnx")
    content = bytearray(exported[1].read_bytes())
    content[len(content) // 2] ^= 1  # of a weight
    (tmp_path / "x.onnx").write_bytes(content)
    with pytest.raises(ValueError, match=r"`path` .* changed: its sha256"):
        Controller(tmp_path / "x.onnx")
    model = onnx.load(str(exported[1]))
    (entry,) = (entry for entry in model.metadata_props if entry.key == "ae_env")
    whole = json.loads(entry.value)
    kind = {"ppo": "regression", "regression": "ppo"}[whole["kind"]]
    (*settings, last), sensors = whole["ranges"]["settings"], whole["ranges"]["sensors"]
    for name, value in (
        *(("states", [[100, 0, 4]]), ("states", whole["states"][1:]), ("format", 2), ("more", 1)),
        *(("frame_shape", [4, 32, 32]), ("kind", "dqn"), ("kind", kind), ("same_light_ev", "NaN")),
        *(("states", whole["states"][:1] * len(whole["states"])), ("sensors", False)),
        *(("pedestal", "0.001"), ("ranges", {}), ("ranges", {"settings": [*settings, last]})),
        *(("ranges", {"settings": v, "sensors": sensors}) for v in (settings, [*settings, [4, 4]])),
        ("ranges", {"settings": [*settings, last[::-1]], "sensors": sensors}),
    ):
        entry.value = json.dumps({**whole, name: value})
        onnx.save(model, str(tmp_path / "x.onnx"))
        with pytest.raises(ValueError, match=rf"`path` .* damaged: .*{name}"):
            Controller(tmp_path / "x.onnx")


def test_what_cannot_be_exported_or_loaded_is_named(exported, context, tmp_path):
    controller, file, broken = Controller(exported[1]), tmp_path / "x.onnx", tmp_path / "y.onnx"
    broken.write_bytes(b"no model")
    frame, signal, nan = np.zeros((1, 4, 64, 64), np.uint8), np.zeros((4, 64, 64)), float("nan")
    ready, state = (frame, np.zeros((1, 3)), np.zeros((1, 2))), controller.states[0]
    act, decide = controller.act, controller.decide
    sensed = functools.partial(decide, signal, state)
    masked = np.ma.masked_greater(signal, 1.0)
    wrong = signal[:, :8], signal.astype(np.uint16), signal - 4000, signal + 14, [[0], 0], masked
    raws = frame[[0, 0]], frame.astype(int), frame + 0.0, frame.astype(object) + 0.5
    for named, call in (
        *(("path", lambda v=v: Controller(v)) for v in (broken, file, "", None)),
        ("policy", lambda: export_agent(make_policy("matrix:P", context), file)),
        ("policy", lambda: export_agent(make_policy("regression?foresight=trend", context), file)),
        ("out", lambda: export_agent(exported[0], tmp_path / "x")),
        *(("sensors", lambda v=v: act(*ready[:2], v)) for v in (None, ready[2] + 5, [["x"] * 2])),
        *(("raw", lambda v=v: act(v, *ready[1:])) for v in raws),
        *(("settings", lambda v=v: act(frame, v, ready[2])) for v in (ready[1] * nan, "x")),
        *(("action_masks", lambda v=v: act(*ready, np.full((1, 64), v))) for v in (False, 1.0)),
        *(("num_cameras", lambda v=v: Controller(exported[1], v)) for v in (0, 1.5)),
        *(("image_speed", lambda v=v: sensed(image_speed=v)) for v in (None, "x", -1.0)),
        ("defocus", lambda: controller.encode_sensors(1.0, -np.inf)),
        *(("current", lambda v=v: decide(signal, v)) for v in (None, (400, 0.01))),
        *(("current.exposure_time", lambda v=v: decide(signal, (100, v, 4))) for v in (0, "1/125")),
        *(("state.iso", lambda v=v: controller.encode_settings((v, 1, 4))) for v in (0, np.inf)),
        *(("planes", lambda v=v: decide(v, state)) for v in wrong),
        *(("planes", lambda v=v: controller.encode_frame(v)) for v in wrong),
    ):
        with pytest.raises(ValueError, match=f"`{named}`"):
            call()
    assert not file.exists()
