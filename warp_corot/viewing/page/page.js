// The page: what the server tells, what the mouse does, and the controls.
import { Scene, add } from './scene.js';

const $ = id => document.getElementById(id), panel = $('panel');
const HINTS = {
  'drag,': 'Drag the body to pull it', 'press,': 'Press on the body and move the mouse away to push in', 'grasp,': 'Drag the body; it stays where you leave it',
  'drag,ball': 'Drag the ball against the body', 'drag,rod': 'Drag the rod against the body', 'grasp,ball': 'Bring the ball to the body, then press on it again to grip',
};
const WINDOW = 10;  // seconds in the graph
const SAVES = {
  picture: ['Picture', 'The scene as you see it, as PNG'], film: ['Film', 'The scene from now on, as MP4 or GIF'], animation: ['Animation', 'A USD animation, for Blender, Houdini or Omniverse'],
  checkpoint: ['Checkpoint', 'The state of the simulation, for Simulation.load'], 'run file': ['Run file', 'The options of this run, for warp-corot simulate'],
};

let scene, socket, page = null, frame = null, waiting = 0, dirty = true, fitted = false, noted = '';
let held = null, lastMove = null, isLeftOut = false;
const drawnAt = [], samples = [];

const send = message => socket?.readyState === WebSocket.OPEN && socket.send(JSON.stringify(message));
const change = what => send({ do: 'change', what });

// --- from the server

function connect() {
  socket = new WebSocket(`${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/socket`);
  socket.binaryType = 'arraybuffer';
  socket.onmessage = ({ data }) => {
    const length = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    TOLD[header.kind](header, data, 4 + length);
  };
  socket.onclose = () => {
    waiting = 0; held = null;
    $('hint').textContent = 'The connection is lost; the page tries again …';
    setTimeout(connect, 1000);
  };
}

const TOLD = {
  page(header) {
    fitted &&= page.tool === header.tool;  // a tool that comes or goes is seen, too
    if (!page) drawBar(header.colormap);
    page = header;
    document.title = page.title;
    scene.setPage(page);
    showPage();
  },
  topology(header, data, at) {
    const sizes = [...header.bodies, ...header.solids];
    const points = sizes.map(([n]) => { const part = new Float32Array(data, at, 3 * n); at += part.byteLength; return part; });
    const parts = sizes.map(([, n], k) => { const triangles = new Uint32Array(data, at, 3 * n); at += triangles.byteLength; return { points: points[k], triangles }; });
    scene.setTopology(header, parts);
  },
  frame(header, data, at) {
    const points = scene.bodies.map(({ points }) => { const part = new Float32Array(data, at, points.length); at += part.byteLength; return part; });
    const shades = header.shaded.map((is, k) => {
      if (!is) return null;
      const part = new Uint8Array(data, at, points[k].length / 3);
      at += 4 * Math.ceil(part.length / 4);
      return part;
    });
    frame = header;
    scene.setFrame(header, points, shades);
    if (samples.length && header.time < samples.at(-1)[0]) samples.length = 0;
    if (!samples.length || header.time > samples.at(-1)[0]) samples.push([header.time, header.force]);
    while (samples[0][0] < header.time - WINDOW) samples.shift();
    waiting += 1;
    if (!fitted) { fitted = true; fit(); }
  },
  draw({ width, height }) {
    const center = scene.center;
    scene.center = [0, 0];
    scene.draw(width, height, 1);
    $('scene').toBlob(blob => { socket.send(blob); scene.center = center; dirty = true; });
  },
  file({ name }, data, at) {
    const link = document.createElement('a');
    link.href = URL.createObjectURL(new Blob([data.slice(at)]));
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  },
};

// --- what is shown

function loop(now) {
  requestAnimationFrame(loop);
  if (lastMove) { send(lastMove); lastMove = null; }
  if (!waiting && !dirty || !frame) return;
  // Drawing without a graphics card takes the processor's time; half of the pictures leave more of it to a slow simulation.
  isLeftOut = !dirty && scene.isSoftware && frame.slow && !isLeftOut;
  if (isLeftOut) { for (; waiting; waiting--) send({ do: 'drawn' }); return; }
  scene.draw();
  showArrows();
  for (dirty = false; waiting; waiting--) { send({ do: 'drawn' }); drawnAt.push(now); }
}

function fit() {
  const { clientWidth: width, clientHeight: height } = $('scene');
  scene.fit({ left: 24, right: width - 24, top: 64, bottom: height - 140 });
  dirty = true;
}

function showArrows() {
  const svg = $('arrows');
  svg.querySelectorAll(':scope > :not(defs)').forEach(each => each.remove());
  for (const { place, force, dragged } of frame.hands) {
    const size = Math.hypot(...force), long = page.size * (0.04 + 0.1 * size / highest()) / size;
    const a = scene.project(place), b = size ? scene.project(add(place, force, long)) : a;
    const mark = (name, values) => { const made = document.createElementNS(svg.namespaceURI, name); Object.entries(values).forEach(([key, value]) => made.setAttribute(key, value)); svg.append(made); return made; };
    mark('circle', { cx: a[0], cy: a[1], r: 4 });
    if (!size || !dragged) continue;
    mark('line', { x1: a[0], y1: a[1], x2: b[0], y2: b[1], 'marker-end': 'url(#head)' });
    mark('text', { x: Math.max(b[0] + 10, 10), y: Math.max(b[1] - 8, 16) }).textContent = withUnit(size, 'N');
  }
}

// A value with a prefix, to three digits.
function scaled(value, unit) {
  const prefixes = [[1e9, 'G'], [1e6, 'M'], [1e3, 'k'], [1, ''], [1e-3, 'm'], [1e-6, 'µ']];
  const [size, prefix] = unit && value ? prefixes.find(([size]) => Math.abs(value) >= 0.9999 * size) || prefixes.at(-1) : [1, ''];
  return [size, prefix + unit];
}
const withUnit = (value, unit) => { const [size, name] = scaled(value, unit); return `${+(value / size).toPrecision(3)} ${name}`; };

function showNumbers() {
  if (!frame || !page) return;
  const now = performance.now();
  while (drawnAt.length && drawnAt[0] < now - 2000) drawnAt.shift();
  const rates = $('rates'), running = page.controls.running;
  const rate = drawnAt.length > 1 ? (drawnAt.length - 1) / (drawnAt.at(-1) - drawnAt[0]) * 1e3 : 0;
  rates.textContent = `${rate.toFixed(0)} frames/s\n` + (running ? `${frame.ratio.toFixed(2)} × real time` : 'paused');
  rates.classList.toggle('slow', running && frame.slow);
  rates.title = frame.slow ? 'This computer cannot simulate as fast as asked for' : 'Pictures in a second, and simulated seconds in a second';
  $('force').textContent = samples.length ? withUnit(samples.at(-1)[1], 'N') : '0 N';
  $('scale').textContent = `ground squares: ${withUnit(scene.cell, 'm').replace(/^(\d0) mm$/, (_, n) => `${n / 10} cm`).replace(/^(\d)00 mm$/, '$10 cm')}`;
  showLegend();
  showGraph();
}

function showLegend() {
  const source = page.sources[page.controls.colors];
  $('legend').hidden = !source;
  if (!source) return;
  const [label, unit] = source, [size, name] = scaled(frame.highest, unit);
  $('legend-title').textContent = label[0].toUpperCase() + label.slice(1) + (name ? ` [${name}]` : '');
  $('ticks').replaceChildren(...[0, 0.25, 0.5, 0.75, 1].map(share => Object.assign(document.createElement('span'), { textContent: +(share * frame.highest / size).toPrecision(3) })));
}

function drawBar(colormap) {
  const paint = $('bar').getContext('2d');
  colormap.match(/.{6}/g).forEach((color, k) => { paint.fillStyle = `#${color}`; paint.fillRect(k, 0, 1, 1); });
}

// The upper end of the forces in the graph; a force that would hardly be felt is no news.
function highest() {
  const most = Math.max(...samples.map(s => s[1]), 1e-5 * page.tissue.young * page.size ** 2, 1e-3), power = 10 ** Math.floor(Math.log10(most));
  return [1, 2, 5, 10].find(step => step * power >= most * 0.999) * power;
}

function showGraph() {
  const canvas = $('curve'), ratio = devicePixelRatio, width = 250, height = 104, left = 44, bottom = 30, top = 8, most = highest();
  if (canvas.width !== width * ratio) { canvas.width = width * ratio; canvas.height = height * ratio; }
  const paint = canvas.getContext('2d'), last = samples.length ? samples.at(-1)[0] : 0, first = Math.max(last - WINDOW, 0);
  const [size, unit] = scaled(most, 'N'), x = t => left + (t - first) / WINDOW * (width - left - 8), y = f => height - bottom - f / most * (height - bottom - top);
  paint.setTransform(ratio, 0, 0, ratio, 0, 0);
  paint.clearRect(0, 0, width, height);
  paint.font = '11px system-ui, sans-serif'; paint.fillStyle = '#5b6875'; paint.strokeStyle = '#d5dbe1'; paint.lineWidth = 1;
  paint.beginPath();
  paint.textAlign = 'right'; paint.textBaseline = 'middle';
  for (const share of [0, 0.5, 1]) {
    paint.moveTo(left, y(share * most)); paint.lineTo(width - 8, y(share * most));
    paint.fillText(+(share * most / size).toPrecision(2), left - 5, y(share * most));
  }
  paint.textAlign = 'center'; paint.textBaseline = 'top';
  for (let t = Math.ceil(first / 2) * 2; t <= first + WINDOW; t += 2) { paint.moveTo(x(t), y(0)); paint.lineTo(x(t), y(0) + 4); paint.fillText(t, x(t), y(0) + 5); }
  paint.stroke();
  paint.fillText('time [s]', (left + width) / 2, height - 12);
  paint.save(); paint.translate(6, (height - bottom) / 2 + 4); paint.rotate(-Math.PI / 2); paint.textBaseline = 'middle'; paint.fillText(`force [${unit}]`, 0, 0); paint.restore();
  paint.strokeStyle = '#1458c8'; paint.lineWidth = 2;
  paint.beginPath();
  samples.forEach(([t, f], k) => (k ? paint.lineTo : paint.moveTo).call(paint, x(t), y(f)));
  paint.stroke();
}

// --- controls

const options = (select, entries, value) => {
  const text = JSON.stringify(entries);
  if (select.dataset.entries !== text) select.replaceChildren(...entries.map(([value, label]) => new Option(label, value)));
  select.dataset.entries = text;
  if (document.activeElement !== select) select.value = value;
};
const asWords = names => names.map(name => [name, name]);

function showPage() {
  const { controls, tissue, choices } = page, mode = `${controls.hand},${page.tool}`;
  $('title').textContent = page.title;
  $('elements').textContent = `${page.elements.toLocaleString('en')} tetrahedra`;
  $('hint').textContent = `${HINTS[mode] || HINTS['drag,']} · drag beside it to turn · wheel: zoom · right button: move · double click: fit`;
  const hand = panel.querySelector(`[name=hand][value="${mode}"]`);
  if (hand) hand.checked = true;
  for (const name of ['radius', 'strength', 'speed']) if (document.activeElement !== panel[name]) setRange(panel[name], controls[name]);
  options(panel.colors, [...Object.entries(page.sources).map(([name, [label]]) => [name, label]), ['', 'none']], controls.colors in page.sources ? controls.colors : '');
  options(panel.surface, asWords(page.surfaces), controls.surface || page.surfaces[0]);
  options(panel.world, asWords(Array.from({ length: page.worlds }, (_, k) => String(k))), controls.world);
  $('worlds').hidden = page.worlds < 2;
  $('axis').value = controls.plane?.axis || '';
  $('share').disabled = $('flip').disabled = !controls.plane;
  options(panel.law, asWords(choices.laws), tissue.law);
  options(panel.rotations, asWords(choices.rotations), tissue.rotations);
  panel.rotations.disabled = tissue.law !== 'corotated';
  for (const name of ['remesh', 'weight']) { panel[name].checked = tissue[name]; panel[name].disabled = !choices[name]; }
  panel.poisson.disabled = !choices.poisson;
  for (const [name, size] of [['young', 1e3], ['poisson', 1], ['density', 1]]) if (document.activeElement !== panel[name]) panel[name].value = +(tissue[name] / size).toPrecision(4);
  const same = page.tissues.find(each => ['young', 'poisson', 'density'].every(name => Math.abs(each[name] / tissue[name] - 1) < 1e-3));
  options($('tissue'), [['', 'own values'], ...page.tissues.map(each => [each.name, each.name])], same?.name || '');
  $('tissue').title = same ? same.source : "Tissues with values from the literature";
  $('pause').textContent = controls.running ? 'Pause' : 'Go on';
  $('step').disabled = controls.running;
  if ($('saves').childElementCount !== page.saves.length + 1) {
    const made = [...page.saves.map(name => [name, ...SAVES[name]]), ['end early', 'Stop', 'End a film or an animation now; what there is of it is kept']];
    $('saves').replaceChildren(...made.map(([name, label, title]) => Object.assign(document.createElement('button'), { type: 'button', textContent: label, title, name })));
  }
  for (const button of $('saves').children) button.disabled = (button.name === 'end early') !== page.busy;
  if (page.note !== noted) {
    noted = page.note;
    if (noted) $('note').textContent = noted;
    clearTimeout(showPage.timer);
    if (!page.busy) showPage.timer = setTimeout(() => { $('note').textContent = ''; }, noted ? 10000 : 3000);
  }
}

function setRange(input, value) {
  input.value = value;
  input.nextElementSibling.textContent = input.name === 'speed' ? `${value} ×` : `${Math.round(100 * value)} %`;
}

function listen() {
  for (const name of ['radius', 'strength', 'speed']) panel[name].oninput = () => { setRange(panel[name], +panel[name].value); change({ [name]: +panel[name].value }); };
  for (const name of ['colors', 'surface', 'world']) panel[name].onchange = () => { change({ [name]: panel[name].value }); panel[name].blur(); };
  for (const [name, size] of [['young', 1e3], ['poisson', 1], ['density', 1]]) panel[name].onchange = () => panel[name].checkValidity() && panel[name].value && send({ do: 'tissue', what: { [name]: size * panel[name].value } });
  for (const name of ['law', 'rotations']) panel[name].onchange = () => { send({ do: 'tissue', what: { [name]: panel[name].value } }); panel[name].blur(); };
  for (const name of ['remesh', 'weight']) panel[name].onchange = () => send({ do: 'tissue', what: { [name]: panel[name].checked } });
  $('tissue').onchange = () => {
    const chosen = page.tissues.find(each => each.name === $('tissue').value);
    if (chosen) send({ do: 'tissue', what: { young: chosen.young, density: chosen.density, ...(page.choices.poisson && { poisson: chosen.poisson }) } });
    $('tissue').blur();
  };
  panel.querySelectorAll('[name=hand]').forEach(input => { input.onchange = () => {
    const [hand, tool] = input.value.split(',');
    change({ hand });
    if (tool !== page.tool) send({ do: 'use tool', name: tool, at: scene.beside() });
  }; });
  const cut = flipped => change({ plane: $('axis').value ? { axis: $('axis').value, share: +$('share').value, flipped } : null });
  $('axis').onchange = $('share').oninput = () => cut(page.controls.plane?.flipped || false);
  $('flip').onclick = () => cut(!page.controls.plane.flipped);
  const pause = $('pause').onclick = () => change({ running: !page.controls.running });
  $('step').onclick = () => send({ do: 'step' });
  $('reset').onclick = () => send({ do: 'reset' });
  $('release').onclick = () => send({ do: 'release' });
  $('saves').onclick = ({ target }) => target.name && send(target.name === 'end early' ? { do: 'end early' } : { do: 'save', what: target.name, seconds: +$('seconds').value || 4 });
  panel.onsubmit = event => event.preventDefault();
  addEventListener('keydown', event => { if (event.code === 'Space' && !/^(INPUT|SELECT|BUTTON|SUMMARY)$/.test(event.target.tagName)) { event.preventDefault(); pause(); } });
  new ResizeObserver(() => frame && fit()).observe($('stage'));
}


// --- the mouse

function listenToMouse(canvas) {
  canvas.onpointerdown = event => {
    if (!frame || held) return;
    canvas.setPointerCapture(event.pointerId);
    const found = event.button === 0 && !event.shiftKey ? scene.pick(event.offsetX, event.offsetY) : null;
    held = { x: event.offsetX, y: event.offsetY, depth: 0, found, isShift: event.button !== 0 || event.shiftKey };
    canvas.classList.add('holding');
    if (found) send(found.tool === undefined ? { do: 'press', body: found.body, at: found.at } : { do: 'press tool', number: found.tool });
  };
  canvas.onpointermove = event => {
    if (!held) return;
    const dx = event.offsetX - held.x, dy = event.offsetY - held.y;
    if (held.found) { held.dx = dx; held.dy = dy; move(); return; }
    if (held.isShift) scene.shift(dx, dy); else scene.turn(dx, dy);
    held.x = event.offsetX; held.y = event.offsetY; dirty = true;
  };
  canvas.onpointerup = canvas.onpointercancel = () => {
    if (held?.found) { if (lastMove) send(lastMove); lastMove = null; send({ do: 'let go' }); }
    held = null;
    canvas.classList.remove('holding');
  };
  canvas.addEventListener('wheel', event => {
    event.preventDefault();
    if (held?.found) { held.depth -= 0.0005 * event.deltaY * page.size; move(); return; }
    scene.zoom(Math.exp(0.0012 * event.deltaY)); dirty = true;
  }, { passive: false });
  canvas.ondblclick = event => { if (frame && !scene.pick(event.offsetX, event.offsetY)) fit(); };
  canvas.oncontextmenu = event => event.preventDefault();
}

function move() {
  const { found, dx = 0, dy = 0 } = held, by = scene[found.tool === undefined ? 'motion' : 'slide'](found.at, dx, dy);
  lastMove = { do: 'move', by: add(by, scene.view().back, -held.depth) };
}

try {
  scene = new Scene($('scene'));
  listen();
  listenToMouse($('scene'));
  connect();
  requestAnimationFrame(loop);
  setInterval(showNumbers, 125);
} catch (error) { $('hint').textContent = error.message; }
