"""The page in a real Chromium: what a user does, and what the page must not do."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import contextmanager
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch
from PIL import Image

from simulator import CameraSettings, RawImage, get_camera, read_raw, write_dng
from tests.agents.viewer.test_viewed_scene import soft_raw

playwright = pytest.importorskip("playwright.sync_api")
expect = playwright.expect
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt install chromium")
#: Time within which the program or page does what it is asked, on a busy machine [s].
PATIENCE = 300
CAMERA = get_camera("nikon_z6")


@contextmanager
def served(log, *arguments):
    """Address of the page that `ae-env view` serves, until it is stopped."""
    command = [sys.executable, "-m", "agents.cli", "view", *map(str, arguments), "--no-open"]
    # NiceGUI serves itself differently where it finds itself under test.
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    with log.open("w") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT, env=env)
    try:
        deadline = time.monotonic() + PATIENCE
        while not (found := re.search(r"open (http\S+)", log.read_text())):
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.1)
        yield found.group(1)
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    assert "Traceback" not in log.read_text()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    log = tmp_path_factory.mktemp("view") / "log.txt"
    with served(log, "bundled:small", "--weights", "none") as found:
        yield found


@pytest.fixture(scope="module")
def address_of_soft_raw(tmp_path_factory):
    folder = tmp_path_factory.mktemp("soft")
    write_dng(folder / "soft.dng", soft_raw(5.6))
    with served(folder / "log.txt", folder / "soft.dng", "--depth", "unknown") as found:
        yield found


@pytest.fixture(scope="module")
def browser():
    expect.set_options(timeout=1e3 * PATIENCE)
    with playwright.sync_playwright() as driver:
        options = ["--no-sandbox"] if os.geteuid() == 0 else []
        found = driver.chromium.launch(executable_path=CHROMIUM, args=options)
        yield found
        found.close()


@contextmanager
def opened(address, browser):
    """The page, loaded; nothing may go wrong in its console, nothing may be asked of others."""
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    context.set_default_timeout(1e3 * PATIENCE)
    opened = context.new_page()
    wrong: list[str] = []
    opened.on("console", lambda m: wrong.append(m.text) if m.type in ("error", "warning") else None)
    opened.on("pageerror", lambda error: wrong.append(str(error)))
    opened.on("request", lambda r: hosts.add(urlsplit(r.url).netloc or r.url[:5]))
    hosts: set[str] = set()
    opened.goto(address)
    opened.wait_for_selector(".state.shown")
    yield opened
    context.close()
    assert wrong == []
    assert hosts - {"data:", "blob:"} == {urlsplit(address).netloc}


def saved(page, button, folder):
    """The file that the button gives."""
    with page.expect_download() as download:
        page.get_by_role("button", name=button).click()
    path = folder / download.value.suggested_filename
    assert path.suffix == f".{button[-3:].lower()}"
    download.value.save_as(path)
    return path


@pytest.fixture
def page(address, browser):
    with opened(address, browser) as found:
        yield found


@pytest.fixture
def soft_page(address_of_soft_raw, browser):
    """The page of the soft raw, at the tab of what one raw gives."""
    with opened(address_of_soft_raw, browser) as found:
        found.get_by_role("tab", name="Refocus, HDR").click()
        found.wait_for_selector(".stage img[src]")
        yield found


def picture(page):
    return page.locator(".stage img").first.get_attribute("src")


def assert_another_picture(page, source):
    page.wait_for_function(
        "s => document.querySelector('.stage img').src.indexOf(s) < 0", arg=source
    )


def slider(page, name):
    return page.locator(f"[aria-label='{name}'] [tabindex='0']")


def test_starts_at_the_best_state_and_marks_where_a_policy_stands(page):
    expect(page.locator(".state", has_text=re.compile(r"\d"))).to_have_count(64)
    scores = [float(state.inner_text().split()[-1]) for state in page.locator(".state").all()]
    shown = page.locator(".state.shown")
    expect(shown).to_contain_text("★")
    assert float(shown.inner_text().split()[-1]) == max(scores)
    page.get_by_label(re.compile("Mark where policies")).click()
    page.get_by_role("option", name="average", exact=True).click()
    expect(page.get_by_text(re.compile(r"^A average: ISO"))).to_be_visible()
    expect(page.locator(".state", has_text="A")).to_have_count(1)


def test_a_key_on_a_slider_shows_its_picture_at_once(page, capsys):
    """From the key to the frame of the screen after the picture has loaded: see docs/viewer.md."""
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


def test_zooms_to_the_pixels_and_compares_two_states_with_a_divider(page):
    before = picture(page)
    page.locator(".stage img").first.click(position={"x": 100, "y": 100})
    assert_another_picture(page, before)
    expect(page.locator(".stage.pixels")).to_be_visible()
    before = picture(page)
    slider(page, "Across").focus()
    for _ in range(20):
        page.keyboard.press("ArrowRight")
    assert_another_picture(page, before)
    page.keyboard.press("Escape")
    page.locator("body").press("z")
    expect(page.locator(".stage.whole")).to_be_visible()
    page.get_by_text("Compare with this (P)").click()
    over = page.locator(".stage .over[src]")
    over.wait_for()
    pinned = over.get_attribute("src")
    before = picture(page)
    slider(page, "Shutter").focus()
    page.keyboard.press("ArrowRight")
    assert_another_picture(page, before)
    expect(page.locator(".plan")).to_contain_text(re.compile(r"ISO \d+, "))
    assert over.get_attribute("src") == pinned
    page.locator("input.divider").focus()
    page.keyboard.press("Home")
    expect(over).to_have_css("clip-path", "inset(0px 0px 0px 0%)")


def test_plays_an_episode_of_two_policies(page):
    page.get_by_role("tab", name="Episode").click()
    for label, name in (("policy A", "average"), ("policy B", "rpi_agc")):
        page.get_by_label(label).fill(name)
    page.get_by_label("frames").fill("6")
    page.get_by_role("button", name="Run").click()
    expect(page.get_by_text("frame 6 of 6")).to_be_visible()
    expect(page.get_by_text(re.compile(r"^A average: .* regret"))).to_have_count(1)
    expect(page.get_by_text(re.compile(r"^B rpi_agc: .* regret"))).to_have_count(1)
    expect(page.locator(".chart polyline")).to_have_count(3 + 2 + 2)
    page.get_by_label("policy A").fill("averagee")
    page.get_by_role("button", name="Run").click()
    expect(page.get_by_text(re.compile("did you mean"))).to_be_visible()


def test_refuses_a_bad_file_and_opens_a_raw_and_gives_a_dng_back(page, tmp_path):
    (bad := tmp_path / "holiday.dng").write_bytes(b"not a raw at all" * 100)
    page.locator("input[type=file]").set_input_files(bad)
    expect(page.locator(".q-notification", has_text="holiday.dng")).to_be_visible()
    page.get_by_role("tab", name="Refocus, HDR").click()
    expect(page.get_by_text("Only a raw can be opened or fused")).to_be_visible()
    expect(page.get_by_role("button", name="Fuse a bracket")).to_be_disabled()
    page.get_by_role("tab", name="Exposure").click()
    light = torch.linspace(0.02, 0.6, 96).repeat(4, 64, 1)
    raw = RawImage(light, CameraSettings(100, 1 / 64, 4), CAMERA, nlf=CAMERA.nlf(100))
    write_dng(tmp_path / "ramp.dng", raw)
    page.locator("input[type=file]").set_input_files(tmp_path / "ramp.dng")
    page.get_by_text("ramp.dng", exact=True).first.wait_for()
    page.locator("button[aria-label^='ISO 400, 1/1000 s, f/8']").click()
    page.locator("button.shown[aria-label^='ISO 400, 1/1000 s, f/8']").wait_for()
    back = read_raw(saved(page, "DNG", tmp_path))
    assert (back.settings.iso, back.settings.f_number) == (400, 8)
    assert back.data.shape == light.shape
    # 4 times the ISO, a quarter of the light by the aperture, 64/1000 of it by the time
    assert float(back.data.mean()) == pytest.approx(0.31 * 64 / 1000, rel=0.02)
    # Without networks the aperture stays as it is, with a message.
    page.get_by_role("tab", name="Refocus, HDR").click()
    page.get_by_role("button", name="Open the aperture").click()
    notice = page.locator(".q-notification", has_text="networks: they estimate the blur")
    expect(notice).to_be_visible()
    expect(page.get_by_role("button", name="Open the aperture")).to_be_enabled()


def test_opens_the_aperture_of_a_raw_and_fuses_its_bracket(soft_page, tmp_path):
    openexr, page = pytest.importorskip("OpenEXR"), soft_page
    expect(page.get_by_role("button", name="save DNG")).to_be_disabled()
    page.get_by_text("f/1.4", exact=True).wait_for()  # the widest
    slider(page, "Wider aperture").focus()
    page.keyboard.press("ArrowLeft")
    page.get_by_text("f/1.6", exact=True).wait_for()
    page.get_by_role("button", name="Open the aperture").focus()
    page.keyboard.press("Enter")
    over = page.locator(".stage .over[src]")
    over.wait_for()
    expect(page.get_by_text(re.compile(r"^right: f/1.6, blur estimated: the w"))).to_be_visible()
    expect(over).not_to_have_attribute("src", picture(page))
    back = read_raw(saved(page, "save DNG", tmp_path))
    assert back.settings.f_number == 1.6
    assert back.data.shape == (4, 96, 144)
    # Blur takes the contrast of the soft half; the sharp one is as it was recorded.
    write_dng(tmp_path / "soft.dng", soft_raw(5.6))
    raw = read_raw(tmp_path / "soft.dng")
    assert back.data[:, 8:-8, :60].equal(raw.data[:, 8:-8, :60])
    assert back.data[1, :, 84:].std() < 0.8 * raw.data[1, :, 84:].std()
    # A bracket of it is fused.
    page.get_by_role("button", name="Fuse a bracket").click()
    shown = re.compile(r"^right: 17 simulated pictures, -4 to \+4 EV")
    expect(page.get_by_text(shown)).to_be_visible()
    with openexr.File(str(saved(page, "save EXR", tmp_path))) as file:
        assert file.channels()["RGB"].pixels.shape == (96, 144, 3)
    with Image.open(saved(page, "save PNG", tmp_path)) as fused:
        assert fused.size == (288, 192)
    # The page lives while it is opened again.
    page.get_by_role("button", name="Open the aperture").click()
    expect(page.get_by_text(re.compile(r"^opening the aperture, 0\.1 megapix"))).to_be_visible()
    page.get_by_role("tab", name="Exposure").click()
    page.locator("button[aria-label^='ISO 6400, 1/2 s, f/4']").click()
    expect(page.locator("button.shown[aria-label^='ISO 6400, 1/2 s, f/4']")).to_be_visible()
    expect(page.get_by_text(re.compile(r"^\d+\.\d+% at white"))).to_be_visible()


def test_fits_the_width_and_two_tabs_show_different_scenes(page, address):
    for width in (390, 1280):
        page.set_viewport_size({"width": width, "height": 844})
        for tab, there in (("Refocus, HDR", "text=Fuse a bracket"), ("Exposure", ".state.shown")):
            page.get_by_role("tab", name=tab).click()
            page.locator(there).wait_for()
            page.wait_for_function("w => document.documentElement.scrollWidth <= w", arg=width)
    other = page.context.new_page()
    other.goto(address)
    other.wait_for_selector(".state.shown")
    other.get_by_role("button", name="Scenes").click()
    thumb = other.locator(".thumb").nth(3)
    thumb.locator("img[src]").wait_for()
    name = thumb.inner_text()
    thumb.click()
    expect(other.locator(".title", has_text=name).first).to_be_visible()
    expect(page.locator(".title").first).not_to_have_text(name)


@pytest.mark.parametrize(
    ("token", "host"), [("", None), ("wrong", None), (None, "example.org"), (None, "evil.test:80")]
)
def test_refuses_whoever_lacks_the_token_or_has_another_name(address, token, host):
    parts = urlsplit(address)
    query = parts.query if token is None else f"token={token}"
    request = urllib.request.Request(f"http://{parts.netloc}/?{query}")
    if host is not None:
        request.add_header("Host", host)
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request, timeout=PATIENCE)
