"""What is shown of a scene, and the page in a real Chromium: what a user does with it."""

import io
import math
import multiprocessing
import os
import re
import shutil
import signal
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from unittest.mock import Mock
from urllib.parse import urlsplit

import numpy as np
import pandas as pd
import pytest
import torch
from fastapi.responses import PlainTextResponse
from PIL import Image
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from ae_env.scenes import Scene
from agents.report.judging import read_choices
from agents.viewer.episode_page import Stopped, play
from agents.viewer.one_raw_page import opened
from agents.viewer.page import PictureStore
from agents.viewer.server import TokenGuard
from agents.viewer.tab import new_file
from agents.viewer.viewed_scene import WINDOW_SIZE, OpenedScene, View, ViewedScene, find_scenes
from simulator import CameraSettings, CameraSimulator, RawImage, get_camera, read_raw, write_dng
from simulator.optics.discs import disc_blur

#: Time within which the program or page does what it is asked, on a busy machine [s].
PATIENCE = 300
CAMERA = get_camera("nikon_z6")
SETTINGS = CameraSettings(100, 1 / 64, 4)


def viewed(light, flip=0):
    scene = Scene.from_array(light, SETTINGS, CAMERA, scene_id="made")
    raw = RawImage(light, SETTINGS, CAMERA, metadata={"flip": flip})
    return ViewedScene(OpenedScene(scene, raw), CameraSimulator(device="cpu"))


def image(picture):
    return np.asarray(Image.open(io.BytesIO(picture.jpeg))).astype(float)


@pytest.mark.parametrize("flip", range(8))  # LibRaw's codes
def test_the_window_lies_where_the_upright_picture_was_clicked(flip):
    light = torch.full((4, 700, 900), 0.02)
    light[:, 120:124, 700:704] = 0.9  # a spot
    seen = viewed(light, flip)
    picture = seen.picture(View(SETTINGS))
    whole = image(picture).mean(axis=2)
    down, right = np.unravel_index(whole.argmax(), whole.shape)
    centre = ((down + 0.5) / whole.shape[0], (right + 0.5) / whole.shape[1])
    window = image(seen.picture(View(SETTINGS, centre=centre))).mean(axis=2)
    assert sorted(window.shape) == sorted(2 * side for side in WINDOW_SIZE)
    found = np.argwhere(window > 0.8 * window.max()).mean(axis=0)
    np.testing.assert_allclose(found, np.array(window.shape) / 2, atol=8)
    close = View(SETTINGS, centre=centre)
    for view, place in ((View(SETTINGS), centre), (close, (0.5, 0.5))):  # two pixels averaged, none
        text = seen.photosite(view, seen.picture(view).capture, *place)
        number, black, white, row, column = map(int, re.findall(r"(?<![A-Z])\d+", text)[:5])
        assert number == pytest.approx(black + 0.9 * (white - black), rel=0.05)
        np.testing.assert_allclose((row, column), (243.5, 1403.5), atol=4)


@pytest.mark.parametrize(("down", "right", "plane"), [(0, 0, 0), (0, 1, 1), (1, 0, 2), (1, 1, 3)])
def test_a_photosite_has_its_filter_and_digital_number(down, right, plane):
    light = torch.tensor([0.1, 0.2, 0.3, 0.4])[:, None, None].expand(4, 64, 64).contiguous()
    seen, view = viewed(light), View(SETTINGS)
    assert CAMERA.cfa == "RGGB"
    place = ((20.5 + down) / 128, (30.5 + right) / 128)
    text = seen.photosite(view, seen.picture(view).capture, *place)
    name, number = text.split()[:2]
    assert name == ("R", "G1", "G2", "B")[plane]
    share = (int(number) - (black := CAMERA.black_level[plane])) / (CAMERA.white_level - black)
    assert share == pytest.approx(float(light[plane, 0, 0]), rel=0.1)
    assert text.endswith(f"row {20 + down}, column {30 + right}")


def test_a_meter_or_region_is_drawn_where_it_looks():
    seen = viewed(torch.full((4, 64, 96), 0.1))
    for name in ("spot", "matrix", "average", "0,0,0.25,0.25"):
        alpha = np.asarray(Image.open(io.BytesIO(seen.weights_over(name))))[..., 3]
        assert alpha.shape == (256, 384)
        assert (alpha[128, 192] == 150) == (name[0] != "0")
        assert (alpha[10, 70] > 0) == (name != "spot")  # in the square that policies see
        assert not alpha[:, :60].any()
    with pytest.raises(ValueError, match="`roi`"):
        seen.weights_over("nonsense")


def test_clipped_pixels_are_marked():
    light = torch.full((4, 64, 64), 0.1)
    light[:, :32, :32] = 3.0
    light[:, 32:, 32:] = -0.1
    shown = image(viewed(light).picture(View(SETTINGS, clipping=True)))
    assert shown[:28, :28].std(axis=(0, 1)).max() < 3
    np.testing.assert_allclose(shown[16, 16], (255, 0, 200), atol=8)
    np.testing.assert_allclose(shown[48, 48], (0, 120, 255), atol=8)
    assert np.ptp(shown[16, 48]) < 40  # grey stays grey


def test_numbers_of_a_flat_scene():
    seen = viewed(torch.full((4, 64, 64), 0.25))
    view = View(CameraSettings(100, 1 / 16, 4), speed=0.5, defocus=4.0)
    readout = seen.readout(view, seen.picture(view).capture)
    assert (readout.white, readout.black) == (pytest.approx(1.0, abs=0.6), 0.0)
    assert readout.motion == pytest.approx(0.5 * 64 / 16)  # speed, height, time
    assert readout.defocus == pytest.approx(4.0)
    huge = viewed(torch.zeros(4, 1025, 1100)).picture(View(SETTINGS)).capture
    assert huge.shape == (4, 341, 366)  # thirds fit the page
    large = viewed(torch.full((4, 512, 384), 0.1))
    for centre in (None, (0.5, 0.5)):  # a window moves as the frame does
        shown = replace(view, centre=centre)
        readout = large.readout(shown, large.picture(shown).capture)
        assert readout.motion == pytest.approx(0.5 * 512 / 16)
        assert readout.defocus == pytest.approx(4.0 * 512 / 64)
    dark = View(CameraSettings(100, 1 / 100, 4))
    readout = seen.readout(dark, seen.picture(dark).capture)
    assert readout.histogram.argmax(axis=1).tolist() == [29] * 4  # 0.16 of white, -2.64 stops
    noise, cost = readout.parts["noise"]
    assert cost == pytest.approx(readout.score * (noise**-0.2 - 1), abs=1e-9)  # of a product
    greys = (View(CameraSettings(iso, 0.01, 4), equal_brightness=True) for iso in (100, 200))
    levels = [image(seen.picture(grey)).mean() for grey in greys]
    assert levels[0] == pytest.approx(levels[1], abs=3)
    np.testing.assert_allclose(readout.histogram.sum(axis=1), 1.0)
    nlf = CAMERA.nlf(100)
    snr = 20 * math.log10(0.12 / math.sqrt(nlf.read[1] + nlf.shot[1] * 0.12))
    assert readout.snr == pytest.approx(snr)
    scores = seen.table(View(best := seen.best())).mean
    assert seen.table(View(best), best).mean[0] == pytest.approx(scores.max(), abs=1e-6)


def test_a_folder_opens_at_its_first_readable_raw_and_few_are_kept(tmp_path):
    for i in range(2):
        (tmp_path / f"0{i}.dng").write_bytes(b"no raw")
    with pytest.raises(ValueError, match=r"none can: 00\.dng: .*; 01\.dng: "):
        find_scenes(str(tmp_path))
    for i in range(1, 7):
        write_dng(tmp_path / f"{i}.dng", RawImage(torch.full((4, 8, 8), 0.1), SETTINGS, CAMERA))
    for byte in (b"\xfe", b"\xff"):  # no UTF-8
        shutil.copy(tmp_path / "1.dng", os.fsencode(tmp_path) + b"/" + byte + b".dng")
    library = find_scenes(str(tmp_path))
    names = list(library.readers)
    assert (library.first, names[:2]) == ("1.dng", ["00.dng", "01.dng"])
    assert names[-2:] == ["\\udcfe.dng", "\\udcff.dng"]
    for i in range(1, 7):
        library.open(f"{i}.dng")
    for path in tmp_path.iterdir():
        path.unlink()
    for i in (6, 5, 4, 3):
        assert library.open(f"{i}.dng").scene.scene_id == f"{i}.dng"
    with pytest.raises((ValueError, OSError), match=r"2\.dng"):
        library.open("2.dng")


def test_thumbnails_are_made_once_and_last_and_an_episode_can_be_stopped(tmp_path):
    for name in ("", "..", "a\0b.dng", "x" * 256):
        with pytest.raises(ValueError, match="cannot be called"):
            new_file(tmp_path, name)
    store, made = PictureStore(), []
    address = store.thumbnail_address("all/a b.dng", lambda: made.append(1) or b"jpeg")
    store.thumbnail_address("all/bad", lambda: float("no raw"))
    for _ in range(300):
        store.address(b"another")
    bodies = [store.fetch("all/a b.dng").body for _ in range(2)]
    assert store.fetch("all/bad").status_code == 204
    assert (address, bodies, made) == ("/frame/all/a%20b.dng", [b"jpeg"] * 2, [1])
    scene = viewed(torch.full((4, 64, 64), 0.1)).scored
    with pytest.raises(Stopped):
        play(["average"], scene, watch=Mock(side_effect=Stopped))


def test_a_scene_is_found_by_its_id_and_what_is_none_is_refused():
    found = find_scenes("snow-1000")
    assert (found.first, "snow-1000" in found.readers) == ("snow-1000", True)
    said = {"bundeld": "did you mean 'bundled'"}
    for what in ("snow-9999", "no/such/folder", "recorded:no/such", "bundeld"):
        with pytest.raises(ValueError, match=f"`.*` .*{said.get(what) or what.rpartition('/')[2]}"):
            find_scenes(what)


def test_a_recorded_grid_is_the_light_of_its_captures(tmp_path):
    for shutter, seconds in (("1-64s", 1 / 64), ("1-16s", 1 / 16)):
        light = torch.full((4, 8, 8), 6.4 * seconds)  # 0.1 at 1/64 s
        raw = RawImage(light, CameraSettings(100, seconds, 4), CAMERA, nlf=CAMERA.nlf(100))
        write_dng(tmp_path / f"iso100_{shutter}_f4.dng", raw)
    library = find_scenes(f"recorded:{tmp_path}")
    scene = library.open(library.first).scene
    assert float(scene.light.mean()) == pytest.approx(6.4 * scene.reference.exposure_time, rel=1e-3)


def soft_raw(f_number):
    """A raw, sharp on the left, soft on the right."""
    tiles = torch.rand(1, 24, 36, generator=torch.Generator().manual_seed(0)) * 0.6 + 0.05
    light = tiles.repeat_interleave(4, 1).repeat_interleave(4, 2).expand(4, 96, 144).clone()
    light[..., 72:] = disc_blur(light, 6.0)[..., 72:]
    return RawImage(light, CameraSettings(100, 1 / 64, f_number), CAMERA, nlf=CAMERA.nlf(100))


def test_what_is_soft_is_blurred_as_the_aperture_opens_where_depth_is_unknown(tmp_path):
    raw = soft_raw(8)
    simulator = CameraSimulator.from_pretrained("nano", device="cpu", cache=None)
    scene = OpenedScene(Scene.from_raw(raw, scene_id="made"))
    view = View(CameraSettings(100, 1 / 256, 4))
    seen = (ViewedScene(scene, simulator, depth=depth) for depth in ("far", "unknown"))
    far, unknown = (each.picture(view).capture for each in seen)
    sharp, soft = (1, slice(None), slice(60)), (1, slice(None), slice(84, None))
    assert float(unknown[sharp].std()) == pytest.approx(float(far[sharp].std()), rel=0.01)
    assert float(unknown[soft].std()) < 0.7 * float(far[soft].std())
    raw = soft_raw(5.6)
    image = opened(raw, 1.6, simulator)
    assert re.match(r"f/1.6, blur estimated: the widest disc has \d+\.\d packed", image.text)
    image.files["dng"](tmp_path / "opened.dng")
    write_dng(tmp_path / "soft.dng", raw)
    before, back = (read_raw(tmp_path / f"{name}.dng") for name in ("soft", "opened"))
    assert (back.settings.f_number, back.data.shape) == (1.6, (4, 96, 144))
    assert back.data[:, 8:-8, :60].equal(before.data[:, 8:-8, :60])  # as it was recorded
    assert back.data[soft].std() < 0.8 * before.data[soft].std()


def _run(log, *arguments):
    """Runs as `ae-env`."""
    from agents.cli.main import main

    # NiceGUI serves itself differently where it finds itself under test, or in a process's child.
    for name in [name for name in os.environ if name.startswith("PYTEST")]:
        del os.environ[name]
    multiprocessing.current_process().name = "MainProcess"
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
    sys.stdout = sys.stderr = log.open("w")
    sys.argv = ["ae-env", *arguments, "--no-open"]
    main()


@contextmanager
def served(forkserver, log, *arguments):
    """Address of the page that `ae-env` serves, until it is stopped."""
    log.touch()
    process = forkserver.Process(target=_run, args=(log, *arguments), daemon=True)
    process.start()
    deadline = time.monotonic() + PATIENCE
    while not (found := re.search(r"open (http\S+)", log.read_text())):
        assert process.is_alive(), log.read_text()
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(0.1)
    yield found.group(1)
    os.kill(process.pid, signal.SIGINT)
    process.join(PATIENCE)
    assert not process.is_alive()
    assert "Traceback" not in log.read_text()


@pytest.fixture(scope="module")
def address(forkserver, tmp_path_factory):
    log = tmp_path_factory.mktemp("view") / "log.txt"
    with served(forkserver, log, "view", "bundled:small", "--weights", "none") as found:
        yield found


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    if chromium is None:
        pytest.skip("no Chromium: apt install chromium")
    playwright.expect.set_options(timeout=1e3 * PATIENCE)
    with playwright.sync_playwright() as driver:
        options = ["--no-sandbox"] if os.geteuid() == 0 else []
        found = driver.chromium.launch(executable_path=chromium, args=options)
        yield found
        found.close()


@pytest.fixture
def page(browser, address):
    """The page, loaded; nothing may go wrong in its console, nothing may be asked of others."""
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    context.set_default_timeout(1e3 * PATIENCE)
    page, wrong, hosts = context.new_page(), [], set()
    page.on("console", lambda m: wrong.append(m.text) if m.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("request", lambda r: hosts.add(urlsplit(r.url).netloc or r.url[:5]))
    page.goto(address)
    page.wait_for_selector(".state.shown")
    yield page
    context.close()
    assert wrong == []
    assert hosts - {"data:", "blob:"} == {urlsplit(address).netloc}


@pytest.fixture
def expect(browser):
    return pytest.importorskip("playwright.sync_api").expect


def saved(page, button, folder):
    """The file that the button gives."""
    with page.expect_download() as download:
        page.get_by_role("button", name=button).click()
    path = folder / download.value.suggested_filename
    assert path.suffix == f".{button[-3:].lower()}"
    download.value.save_as(path)
    return path


def picture(page):
    return page.locator(".stage img").first.get_attribute("src")


@contextmanager
def another_picture(page):
    before, changed = picture(page), "s => document.querySelector('.stage img').src.indexOf(s) < 0"
    yield
    page.wait_for_function(changed, arg=before)


def slider(page, name):
    return page.locator(f"[aria-label='{name}'] [tabindex='0']")


@pytest.mark.slow
def test_the_best_state_comes_first_and_a_key_shows_another_at_once(page, expect, capsys):
    """From the key to the frame of the screen after the picture has loaded: see docs/viewer.md."""
    expect(page.locator(".state", has_text=re.compile(r"\d"))).to_have_count(64)
    scores = [float(text.lstrip("★")) for text in page.locator(".state").all_inner_texts()]
    shown = page.locator(".state.shown")
    expect(shown).to_contain_text("★")
    assert float(shown.inner_text().lstrip("★")) == max(scores)
    page.evaluate("""() => {
      window.times = []; let begun = 0;
      document.addEventListener('keydown', () => { begun = performance.now(); }, true);
      document.querySelector('.stage img').addEventListener('load', () => requestAnimationFrame(
        () => { if (begun) window.times.push(performance.now() - begun); begun = 0; }));
    }""")
    slider(page, "Shutter").focus()
    for i in range(8):
        page.keyboard.press("ArrowRight" if i % 4 < 2 else "ArrowLeft")
        page.wait_for_function("n => window.times.length > n", arg=i)
    median = float(np.median(page.evaluate("window.times")))
    with capsys.disabled():
        print(f"from a key to its picture: {median:.0f} ms", end=" ")
    assert median < 2000.0
    # The pixels of a place, which keys move.
    with another_picture(page):
        page.locator(".stage img").first.click(position={"x": 100, "y": 100})
    expect(page.locator(".stage.pixels")).to_be_visible()
    slider(page, "Across").focus()
    with another_picture(page):
        for _ in range(20):
            page.keyboard.press("ArrowRight")
    page.keyboard.press("Escape")
    page.locator("body").press("z")
    expect(page.locator(".stage.whole")).to_be_visible()
    # A locked exposure stays: what ISO takes, the time gives back.
    ev = page.get_by_text(re.compile("^EV100 "))
    locked = ev.inner_text()
    page.locator("body").press("l")
    slider(page, "ISO").focus()
    page.keyboard.press("ArrowRight")
    expect(page.locator("[aria-label=ISO]")).to_have_attribute("aria-valuetext", "125")
    expect(page.get_by_text(re.compile("^ISO 125"))).to_be_attached()
    assert ev.inner_text() == locked
    page.locator("body").press("l")
    # Two states, with a divider.
    page.get_by_text("Keep this as B (P)").click()
    (over := page.locator(".stage .over[src]")).wait_for()
    pinned = over.get_attribute("src")
    slider(page, "Shutter").focus()
    with another_picture(page):
        page.keyboard.press("ArrowRight")
    expect(page.locator(".plan")).to_contain_text(re.compile(r"ISO \d+, "))
    assert over.get_attribute("src") == pinned
    page.locator("input.divider").focus()
    page.keyboard.press("Home")
    expect(over).to_have_css("clip-path", "inset(0px 0px 0px 0%)")
    box = page.locator(".stage").bounding_box()
    page.mouse.move(box["x"] + 2, box["y"] + 90)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 90, steps=3)
    page.mouse.up()
    expect(over).to_have_css("clip-path", re.compile(r"inset\(0px 0px 0px (49|50)"))
    expect(page.locator(".stage.whole")).to_be_visible()  # a drag is no click
    page.mouse.wheel(0, -100)
    expect(page.locator(".scale")).to_have_attribute("data-text", re.compile(r"\d px, zoom 1.2"))
    screen = page.context.new_cdp_session(page)
    for kind, apart in (("Start", 30), ("Move", 45), ("Move", 60), ("End", 0)):  # two fingers
        points = [{"x": box["x"] + 90 + k * apart, "y": box["y"] + 90} for k in (-1, 1) if apart]
        screen.send("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})
    expect(page.locator(".scale")).to_have_attribute("data-text", re.compile(r"\d px, zoom 2.4"))
    # The map has one stop of the Tab key; arrows choose.
    expect(page.locator(".state[tabindex='0']")).to_have_count(1)
    page.locator("[title^='ISO 400, 1/1000 s, f/11']").click()
    states = {"ArrowRight": "ISO 400, 1/125 s, f/11", "ArrowDown": "ISO 6400, 1/125 s, f/4"}
    for key, state in states.items():
        page.keyboard.press(key)
        expect(page.locator(".state:focus")).to_have_attribute("aria-label", re.compile(state))
        expect(page.locator(".state.shown")).to_have_attribute("title", re.compile(state))
    page.mouse.move(box["x"] + 90, box["y"] + 90)
    expect(page.get_by_text(re.compile(r"^(R|G1|G2|B) \d+ of 1008 to 15520, row"))).to_be_visible()


@pytest.mark.slow
def test_axe_finds_no_serious_fault_in_any_tab(page):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    # What fades in has its contrast at the end.
    ended = "() => Promise.allSettled(document.getAnimations().map(a => a.effect.getTiming()"
    ended += ".iterations === Infinity ? 0 : a.finished))"

    def faults():
        page.evaluate(ended)
        found = axe.run(page).response["violations"]
        found = [v for v in found if v["impact"] in ("serious", "critical")]
        return [(v["id"], [node["html"] for node in v["nodes"]]) for v in found]

    choices = {"Episode": "light", "Refocus, HDR": "", "Exposure": "Draw metering weights"}
    for width in (390, 1280):
        page.set_viewport_size({"width": width, "height": 800})
        for name, choice in choices.items():
            page.get_by_role("tab", name=name).click()
            page.wait_for_timeout(500)  # its pictures
            assert faults() == []
            if choice:
                page.get_by_label(choice).click()
                page.get_by_role("option").first.wait_for()
                assert faults() == []
                page.keyboard.press("Escape")
    page.goto(page.url.replace("scene=", "scene=no-"))
    page.wait_for_selector(".state.shown")
    page.get_by_role("button", name="Close").wait_for()
    assert faults() == []
    page.get_by_role("button", name="Close").click()
    page.get_by_role("button", name="Scenes").click()
    page.locator(".thumb").first.wait_for()
    assert faults() == []


@pytest.mark.slow
def test_policies_in_two_tabs_that_fit_the_width(page, expect, address, tmp_path):
    page.get_by_label(re.compile("Mark where policies")).click()
    page.get_by_role("option", name="average", exact=True).click()
    expect(page.get_by_text(re.compile("average: ISO"))).to_be_visible()
    expect(page.locator(".state[title$='average']")).to_have_count(1)
    page.get_by_role("tab", name="Episode").click()
    for label, name in (("policy A", "average"), ("policy B", "rpi_agc")):
        page.get_by_label(label).fill(name)
    page.get_by_label("frames").fill("6")
    page.get_by_role("button", name="Run").click()
    expect(page.locator("[aria-label=Frame]")).to_have_attribute("aria-valuetext", "6")
    expect(page.get_by_text(re.compile(r"^A average: .* regret"))).to_have_count(1)
    expect(page.get_by_text(re.compile(r"^B rpi_agc: .* regret"))).to_have_count(1)
    expect(page.locator(".charts canvas")).to_have_count(3)
    rows = pd.read_csv(saved(page, "save CSV", tmp_path))
    assert rows.policy.tolist() == ["average"] * 7 + ["rpi_agc"] * 7
    ev100 = np.log2(rows.f_number**2 / rows.exposure_time * 100 / rows.iso)
    np.testing.assert_allclose(rows.ev100, ev100, atol=0.05)
    assert saved(page, "save GIF", tmp_path).read_bytes()[:6] == b"GIF89a"
    link = "a=average&b=rpi_agc&light=shadows&frames=6&seed=0"
    assert page.url.endswith(link)
    page.get_by_label("policy A").fill("averagee")
    page.get_by_role("button", name="Run").click()
    expect(page.get_by_text(re.compile("did you mean"))).to_be_visible()
    page.get_by_role("button", name="Close").click()
    for width in (390, 1280):
        page.set_viewport_size({"width": width, "height": 844})
        for name, there in (("Refocus, HDR", "text=Fuse a bracket"), ("Exposure", ".state.shown")):
            page.get_by_role("tab", name=name).click()
            page.locator(there).wait_for()
            page.wait_for_function("w => document.documentElement.scrollWidth <= w", arg=width)
        if width == 1280:  # all is in sight
            assert page.evaluate("document.documentElement.scrollHeight") <= 844
            continue
        page.evaluate("scrollTo(0, 400)")
        top = "document.querySelector('.stage').getBoundingClientRect().top"
        page.wait_for_function(f"() => scrollY > 200 && {top} === 0")
    # Another tab of the browser shows another scene, and goes back, forward, and loads it again.
    other = page.context.new_page()
    other.goto(address.partition("?")[0])  # the cookie has the token
    other.wait_for_selector(".state.shown")
    other.get_by_role("button", name="Scenes").click()
    (thumb := other.locator(".thumb").nth(3)).locator("img[src]").wait_for()
    name = thumb.inner_text()
    thumb.click()
    expect(other.locator(".title", has_text=name).first).to_be_visible()
    expect(page.locator(".title").first).not_to_have_text(name)
    other.wait_for_url(f"**scene={name}&**")
    other.go_back()
    expect(other.locator(".title", has_text=name)).to_have_count(0)
    other.goto(f"{address.partition('?')[0]}?tab=episode&{link}7")
    expect(other.get_by_label("policy B")).to_have_value("rpi_agc")
    other.goto(f"{address.partition('?')[0]}?scene={name}&iso=1600&t=1/15&n=4&tab=exposure")
    other.locator("button.shown[aria-label^='ISO 1600, 1/15 s, f/4']").wait_for()
    expect(other.locator(".title").first).to_have_text(name)


@pytest.mark.slow
def test_takes_a_raw_and_gives_files_back(page, expect, tmp_path):
    openexr = pytest.importorskip("OpenEXR")
    notice, upload = page.locator(".q-notification__message"), page.locator("input[type=file]")
    faults = {"bad.jpg": "is a JPEG, not a raw file", "raw.dng": "must be a camera raw .* damaged"}
    for name, fault in faults.items():
        (tmp_path / name).write_bytes(b"\xff\xd8\xff" if name == "bad.jpg" else b"any" * 100)
        with page.expect_request(re.compile("/upload/")) as request:
            upload.set_input_files(tmp_path / name)
        said = rf"^{name} {fault}\. (Choose a DNG, CR2, NEF or another raw) of a camera .*"
        expect(notice).to_have_text([re.compile(said)])  # the latest alone
    for form in ({"name": "no file"}, {}):
        answer = page.request.post(request.value.url, multipart=form)
        assert answer.status == 400
        assert answer.text() == "No file arrived. Choose a DNG, CR2, NEF or another raw."
    page.get_by_role("tab", name="Refocus, HDR").click()
    expect(page.get_by_text("Only a raw can be opened or fused")).to_be_visible()
    expect(page.get_by_role("button", name="Fuse a bracket")).to_be_disabled()
    page.get_by_role("tab", name="Exposure").click()
    raw = soft_raw(5.6)
    write_dng(tmp_path / "soft.dng", raw)
    upload.set_input_files(tmp_path / "soft.dng")
    page.get_by_text("soft.dng", exact=True).first.wait_for()
    expect(notice).to_have_count(0)
    page.locator("button[aria-label^='ISO 400, 1/1000 s, f/8']").click()
    page.locator("button.shown[aria-label^='ISO 400, 1/1000 s, f/8']").wait_for()
    back = read_raw(saved(page, "DNG", tmp_path))
    assert (back.settings.iso, back.settings.f_number) == (400, 8)
    assert back.data.shape == raw.data.shape
    # 4 times the ISO, half of the light by the aperture, 64/1000 of it by the time
    expected = float(raw.data.mean()) * 2 * 64 / 1000
    assert float(back.data.mean()) == pytest.approx(expected, rel=0.02)
    # Without networks the aperture stays as it is, with a message.
    page.get_by_role("tab", name="Refocus, HDR").click()
    page.get_by_text("f/1.4", exact=True).wait_for()  # the widest
    slider(page, "Wider aperture").focus()
    page.keyboard.press("ArrowLeft")
    page.get_by_text("f/1.6", exact=True).wait_for()
    page.get_by_role("button", name="Open the aperture").click()
    expect(notice).to_contain_text("networks: they estimate the blur")
    expect(page.get_by_role("button", name="Open the aperture")).to_be_enabled()
    # A bracket is fused.
    before = picture(page)
    page.get_by_role("button", name="Fuse a bracket").focus()
    page.keyboard.press("Enter")
    shown = re.compile(r"^right: 17 simulated pictures, -4 to \+4 EV")
    expect(page.get_by_text(shown)).to_be_visible()
    expect(page.locator(".stage .over[src]")).not_to_have_attribute("src", before)
    expect(page.get_by_role("button", name="save DNG")).to_be_disabled()
    with openexr.File(str(saved(page, "save EXR", tmp_path))) as file:
        assert file.channels()["RGB"].pixels.shape == (96, 144, 3)
    with Image.open(saved(page, "save PNG", tmp_path)) as fused:
        assert fused.size == (288, 192)


@pytest.mark.slow
def test_a_judge_chooses_by_keys_and_knows_nothing(browser, expect, forkserver, tmp_path):
    asked = ("--scenes", "bundled:small", "--pairs", "2", "--out", str(tmp_path / "ann.csv"))
    keys = {"Tab": 0, "ArrowLeft": 1, "Backspace": 0, "ArrowRight": 1, "Space": 2}
    with served(forkserver, tmp_path / "log.txt", "judge", *asked) as address:
        page = browser.new_page()
        page.goto(address)
        for key, number in keys.items():
            page.keyboard.press(key)
            expect(page.get_by_text(f"{number} of 2")).to_be_visible()
            expect(page.locator("img[src^='/frame/']")).to_have_count(2 * (number < 2))
            if key == "Tab":
                texts = re.sub("\n+", "\n", page.locator("body").inner_text()).strip()
        page.close()
    told = "← left, → right, ↓ or space: equal, backspace: undo the last"
    assert texts == f"Which picture is better?\n0 of 2\n{told}"
    assert read_choices(tmp_path / "ann.csv").choice.tolist() == ["right", "equal"]


def test_whoever_lacks_the_token_or_has_another_name_is_refused():
    guard = TokenGuard(PlainTextResponse("page"), token="secret", port=8000)
    client = partial(TestClient, guard, base_url="http://127.0.0.1:8000")
    foreign, ours = {"Origin": "http://evil.test"}, "ae-env-view-8000"
    others = {"Cookie": f'x; =; {ours}=stale; y="; {ours}=secret'}  # of a server beside this one
    for query, headers, status in (
        ("", {}, 403),
        ("?token=wrong", {}, 403),
        ("?token=secret", {"Host": "evil.test:8000"}, 403),
        ("?token=secret", foreign, 403),
        ("?token=secret", {"Origin": "http://[evil"}, 403),
        ("?token=secret", {"Host": "localhost:8000"}, 200),
        *(("", others, 200), ("", {"Cookie": f"{ours}=stale"}, 403)),
    ):
        assert client().get(f"/{query}", headers=headers).status_code == status
    usual = TokenGuard(PlainTextResponse("page"), token="secret", port=80)  # browsers leave it out
    assert TestClient(usual, base_url="http://127.0.0.1").get("/?token=secret").text == "page"
    known = client()
    known.get("/?token=secret")
    assert known.get("/").text == "page"  # by its cookie
    with pytest.raises(WebSocketDisconnect) as caught:
        known.websocket_connect("/", headers=foreign).__enter__()
    assert caught.value.code == 1008
