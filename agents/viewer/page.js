// What a page does in the browser itself: zoom and drag of the picture, arrow keys in the map.
const ARROWS = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] };
const MOST = 16;
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const read = (stage, name, other) => parseFloat(stage.style.getPropertyValue(name)) || other;
const placed = (stage) => [read(stage, '--x', 0), read(stage, '--y', 0), read(stage, '--zoom', 1)];

// Shows a stage's picture `zoom` times as large, moved by percents of the stage.
function place(stage, x, y, zoom) {
  stage.style.setProperty('--zoom', zoom);
  stage.style.setProperty('--x', clamp(x, 100 - 100 * zoom, 0) + '%');
  stage.style.setProperty('--y', clamp(y, 100 - 100 * zoom, 0) + '%');
  stage.style.touchAction = zoom > 1 ? 'none' : '';  // a finger scrolls the page, or moves what is enlarged
  drawScale(stage);
}

// Zooms about a point of the stage, in percents.
function zoomBy(stage, factor, right = 50, down = 50) {
  const [x, y, zoom] = placed(stage), next = clamp(zoom * factor, 1, MOST);
  place(stage, right - (right - x) * next / zoom, down - (down - y) * next / zoom, next);
  return next !== zoom;
}

// A bar of 1, 2 or 5 times a power of ten photosites, at most a quarter of the stage long.
function drawScale(stage) {
  const bar = stage.querySelector('.scale'), across = read(stage, '--photosites', 0);
  if (!bar || !across) return;
  const zoom = placed(stage)[2], most = across / zoom / 4, ten = 10 ** Math.floor(Math.log10(most));
  const count = Math.max(1, ten * [5, 2, 1].find((n) => n * ten <= most));
  bar.style.width = 100 * count * zoom / across + '%';
  bar.dataset.text = `${count} px` + (zoom > 1.01 ? `, zoom ${zoom.toFixed(1)}` : '');
}

function divide(stage, percent) {
  stage.style.setProperty('--cut', clamp(percent, 0, 100) + '%');
}

addEventListener('load', (e) => {
  const stage = e.target.closest && e.target.closest('.stage');
  if (stage) drawScale(stage);
}, true);

addEventListener('wheel', (e) => {
  const stage = e.target.closest('.stage');
  if (!stage || e.ctrlKey) return;
  const box = stage.getBoundingClientRect(), share = (at, from, size) => 100 * (at - from) / size;
  const [right, down] = [share(e.clientX, box.left, box.width), share(e.clientY, box.top, box.height)];
  // At either end of the zoom the page scrolls.
  if (zoomBy(stage, 1.2 ** clamp(-e.deltaY / 100, -2, 2), right, down)) e.preventDefault();
}, { passive: false });

let drag = null;
addEventListener('pointerdown', (e) => {
  const stage = e.target.closest('.stage');
  drag = stage && e.button === 0 ? { stage, e, at: placed(stage), far: false } : null;
  if (drag) drag.edge = e.target.closest('.edge');
});
addEventListener('pointermove', (e) => {
  if (!drag) return;
  const { stage, at } = drag, box = stage.getBoundingClientRect();
  const [right, down] = [e.clientX - drag.e.clientX, e.clientY - drag.e.clientY];
  drag.far ||= Math.hypot(right, down) > 4;
  if (drag.edge) {
    const cut = 100 * (e.clientX - box.left) / box.width;
    divide(stage, cut);
    stage.parentElement.querySelector('.divider').value = cut;
  } else if (drag.far) place(stage, at[0] + 100 * right / box.width, at[1] + 100 * down / box.height, at[2]);
});
addEventListener('pointercancel', () => { drag = null; });
addEventListener('click', (e) => {
  if (drag && (drag.far || drag.edge)) e.stopPropagation();  // the end of a drag is no click
  drag = null;
}, true);
addEventListener('pointerup', () => setTimeout(() => { drag = null; }));

// Two fingers zoom and move: the distance between them, and their middle in percents of the stage.
let pinch = null;
const pinched = (stage, [one, other]) => {
  const box = stage.getBoundingClientRect(), middle = (a, b, from, size) => 50 * (a + b - 2 * from) / size;
  return {
    stage, size: Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY),
    right: middle(one.clientX, other.clientX, box.left, box.width),
    down: middle(one.clientY, other.clientY, box.top, box.height),
  };
};
addEventListener('touchstart', (e) => {
  const stage = e.touches.length === 2 && e.target.closest('.stage');
  pinch = stage ? pinched(stage, e.touches) : null;
  if (pinch) drag = null;
});
addEventListener('touchmove', (e) => {
  if (!pinch) return;
  e.preventDefault();  // the page does not scroll
  const { stage, size, right, down } = pinch, [x, y, zoom] = placed(stage);
  pinch = pinched(stage, e.touches);
  place(stage, x + pinch.right - right, y + pinch.down - down, zoom);
  zoomBy(stage, pinch.size / size, pinch.right, pinch.down);
}, { passive: false });
for (const end of ['touchend', 'touchcancel']) addEventListener(end, () => { pinch = null; });

addEventListener('keydown', (e) => {
  const arrow = ARROWS[e.key], stage = e.target.closest && e.target.closest('.stage');
  if (e.ctrlKey || e.altKey || e.metaKey) return;
  if (stage && '+=-'.includes(e.key)) zoomBy(stage, e.key === '-' ? 1 / 1.5 : 1.5);
  if (!arrow) return;
  if (stage) {
    const [x, y, zoom] = placed(stage);
    place(stage, x - 10 * arrow[1], y - 10 * arrow[0], zoom);
    e.preventDefault();
  }
  // The panels of 4 x 4 states lie two by two.
  const states = [...document.querySelectorAll('.state')], k = states.indexOf(e.target);
  if (k < 0) return;
  e.preventDefault();
  const row = (k >> 5) * 4 + ((k >> 2) & 3) + arrow[0], column = ((k >> 4) & 1) * 4 + (k & 3) + arrow[1];
  if (row < 0 || row > 7 || column < 0 || column > 7) return;
  const next = states[(row >> 2) * 32 + (column >> 2) * 16 + (row & 3) * 4 + (column & 3)];
  next.focus();
  next.click();
});

// Quasar's list of options can be focused itself, which hides the options from a screen reader.
const lists = new MutationObserver((changes) => {
  const added = changes.flatMap((change) => [...change.addedNodes]);
  for (const node of added.filter((n) => (n.id || '').startsWith('q-portal'))) {
    lists.observe(node, { childList: true, subtree: true });
  }
  for (const list of document.querySelectorAll('.q-virtual-scroll__content')) list.removeAttribute('tabindex');
});
addEventListener('DOMContentLoaded', () => lists.observe(document.body, { childList: true }));
