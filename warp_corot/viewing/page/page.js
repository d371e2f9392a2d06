// The page: messages of the server, pictures, and the mouse.

import { drawBar, highestForce, keep, lastForce, length, withUnit } from './numbers.js';
import { showArrows, showGraph, showLegend } from './numbers.js';
import { listen, showPage } from './panel.js';
import { Scene } from './scene.js';
import { add } from './surface.js';

const $ = id => document.getElementById(id), canvas = $('scene');
let scene, socket, page, frame;
let undrawn = 0, isStale = true, isFitted = false, isLeftOut = false;  // what is not in the picture yet
let held = null, lastMove = null;
const drawnAt = [];

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

// --- messages of the server

function connect() {
  socket = new WebSocket(`${location.protocol.replace('http', 'ws')}//${location.host}/`);
  socket.binaryType = 'arraybuffer';
  socket.onmessage = ({ data }) => {
    const size = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size)));
    let at = 4 + size;
    TOLD[header.kind](header, (kind, count) => {
      const array = new kind(data, at, count);
      at += 4 * Math.ceil(array.byteLength / 4);
      return array;
    });
  };
  socket.onclose = () => {
    undrawn = 0;
    held = null;
    $('hint').textContent = 'The connection is lost; the page tries again …';
    setTimeout(connect, 1000);
  };
}

// What to do with each kind of message: its header, and a function that takes the next array.
const TOLD = {
  page(header) {
    if (!page) drawBar($('bar'), header.colormap);
    isFitted &&= page.tool === header.tool;  // a tool that comes or goes is seen, too
    page = header;
    scene.setPage(page);
    showPage(page);
  },
  topology(header, next) {
    const sizes = [...header.bodies, ...header.solids];
    const points = sizes.map(([count]) => next(Float32Array, 3 * count));
    const parts = sizes.map(([, count], k) => ({ points: points[k], triangles: next(Uint32Array, 3 * count) }));
    scene.setTopology(header, parts);
  },
  frame(header, next) {
    const points = scene.bodies.map(body => next(Float32Array, body.points.length));
    const shades = points.map((each, k) => header.shaded[k] ? next(Uint8Array, each.length / 3) : null);
    frame = header;
    scene.setFrame(header, points, shades);
    keep(header.time, header.force);
    undrawn += 1;
    if (!isFitted) fit();
  },
  draw({ width, height }) {
    const { center } = scene;
    scene.center = [0, 0];
    scene.draw(width, height, 1);
    canvas.toBlob(blob => socket.send(blob));
    scene.center = center;
    isStale = true;
  },
  file({ name, size }, next) {
    const link = document.createElement('a');
    link.href = URL.createObjectURL(new Blob([next(Uint8Array, size)]));
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  },
};

// --- pictures

function loop(now) {
  requestAnimationFrame(loop);
  if (lastMove) send(lastMove);
  lastMove = null;
  if (!frame || !undrawn && !isStale) return;
  // Without a graphics card pictures take time from a simulation that is slow already: every other one is left out.
  isLeftOut = !isStale && scene.isSoftware && frame.slow && !isLeftOut;
  if (!isLeftOut) {
    scene.draw();
    showArrows($('arrows'), frame.hands, scene, highestForce(page));
    drawnAt.push(now);
    isStale = false;
  }
  for (; undrawn; undrawn--) send({ do: 'drawn' });
}

function fit() {
  scene.fit({ left: 24, right: canvas.clientWidth - 24, top: 64, bottom: canvas.clientHeight - 140 });
  isFitted = isStale = true;
}

function showNumbers() {
  if (!frame) return;
  while (drawnAt[0] < performance.now() - 2000) drawnAt.shift();
  const rates = $('rates'), { running, colors } = page.controls, isSlow = running && frame.slow;
  const rate = drawnAt.length > 1 ? 1e3 * (drawnAt.length - 1) / (drawnAt.at(-1) - drawnAt[0]) : 0;
  rates.textContent = `${rate.toFixed(0)} frames/s\n${running ? `${frame.ratio.toFixed(2)} × real time` : 'paused'}`;
  rates.classList.toggle('slow', isSlow);
  rates.title = isSlow ? 'Slower than asked for' : 'Pictures, and simulated seconds, in a second';
  $('force').textContent = withUnit(lastForce(), 'N');
  $('scale').textContent = `ground squares: ${length(scene.cell)}`;
  showLegend($('legend'), $('legend-title'), $('ticks'), page.sources[colors], frame.highest);
  showGraph($('curve'), highestForce(page));
}

// --- the mouse

function listenToMouse() {
  canvas.onpointerdown = ({ button, shiftKey, pointerId, offsetX: x, offsetY: y }) => {
    if (!frame || held) return;
    canvas.setPointerCapture(pointerId);
    const isShift = button !== 0 || shiftKey, found = isShift ? null : scene.pick(x, y);
    held = { x, y, dx: 0, dy: 0, depth: 0, found, isShift };
    canvas.classList.add('holding');
    if (found?.tool !== undefined) send({ do: 'press tool', number: found.tool });
    else if (found) send({ do: 'press', body: found.body, at: found.at });
  };
  canvas.onpointermove = ({ offsetX, offsetY }) => {
    if (!held) return;
    Object.assign(held, { dx: offsetX - held.x, dy: offsetY - held.y });
    if (held.found) return move();
    scene[held.isShift ? 'shift' : 'turn'](held.dx, held.dy);
    Object.assign(held, { x: offsetX, y: offsetY });
    isStale = true;
  };
  canvas.onpointerup = canvas.onpointercancel = () => {
    if (held?.found) {
      if (lastMove) send(lastMove);
      send({ do: 'let go' });
    }
    held = lastMove = null;
    canvas.classList.remove('holding');
  };
  canvas.addEventListener('wheel', event => {
    event.preventDefault();
    if (held?.found) {
      held.depth -= 0.0005 * event.deltaY * page.size;
      return move();
    }
    scene.zoom(Math.exp(0.0012 * event.deltaY));
    isStale = true;
  }, { passive: false });
  canvas.ondblclick = ({ offsetX, offsetY }) => { if (frame && !scene.pick(offsetX, offsetY)) fit(); };
  canvas.oncontextmenu = event => event.preventDefault();
}

function move() {
  const { found, dx, dy, depth } = held, way = found.tool === undefined ? 'motion' : 'slide';
  lastMove = { do: 'move', by: add(scene[way](found.at, dx, dy), scene.view().back, -depth) };
}

try {
  scene = new Scene(canvas);
  listen(send, () => scene.beside());
  listenToMouse();
  connect();
  requestAnimationFrame(loop);
  setInterval(showNumbers, 125);
  new ResizeObserver(() => { if (frame) fit(); }).observe(canvas);
} catch (error) {
  $('hint').textContent = error.message;
}
