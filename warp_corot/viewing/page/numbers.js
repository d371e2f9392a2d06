// Numbers with units, the scale of the colours, the graph of the force, and the arrows of hands.

const WINDOW = 10;  // seconds in the graph
const PREFIXES = [[1e9, 'G'], [1e6, 'M'], [1e3, 'k'], [1, ''], [1e-3, 'm'], [1e-6, 'µ']];
const SVG = 'http://www.w3.org/2000/svg';
const samples = [];  // times and forces

// A size and its name by which to express a value.
function unitFor(value, unit) {
  if (!unit || !value) return [1, unit];
  const [size, prefix] = PREFIXES.find(([each]) => Math.abs(value) >= 0.9999 * each) || PREFIXES.at(-1);
  return [size, prefix + unit];
}

export function withUnit(value, unit) {
  const [size, name] = unitFor(value, unit);
  return `${+(value / size).toPrecision(3)} ${name}`;
}

export function length(value) {
  return value > 0.0099 && value < 0.99 ? `${+(100 * value).toPrecision(3)} cm` : withUnit(value, 'm');
}

export const lastForce = () => samples.at(-1)?.[1] || 0;

export function keep(time, force) {
  if (samples.length && time < samples.at(-1)[0]) samples.length = 0;
  if (!samples.length || time > samples.at(-1)[0]) samples.push([time, force]);
  while (samples[0][0] < time - WINDOW) samples.shift();
}

export function drawBar(canvas, colormap) {
  const paint = canvas.getContext('2d');
  colormap.match(/.{6}/g).forEach((color, k) => { paint.fillStyle = `#${color}`; paint.fillRect(k, 0, 1, 1); });
}

export function showLegend(figure, title, ticks, source, highest) {
  figure.hidden = !source;
  if (!source) return;
  const [label, unit] = source, [size, name] = unitFor(highest, unit);
  title.textContent = label[0].toUpperCase() + label.slice(1) + (name ? ` [${name}]` : '');
  ticks.replaceChildren(...[0, 0.25, 0.5, 0.75, 1].map(share => {
    const tick = document.createElement('span');
    tick.textContent = +(share * highest / size).toPrecision(3);
    return tick;
  }));
}

// The upper end of the graph. A force that hardly deforms the body is no news.
export function highestForce(page) {
  const least = Math.max(1e-5 * page.tissue.young * page.size ** 2, 1e-3);
  const most = Math.max(...samples.map(([, force]) => force), least), power = 10 ** Math.floor(Math.log10(most));
  return power * [1, 2, 5, 10].find(step => step * power >= most * 0.999);
}

export function showGraph(canvas, most) {
  const { clientWidth: width, clientHeight: height } = canvas, ratio = devicePixelRatio;
  const left = 44, right = width - 8, top = 8, bottom = height - 30;
  const first = Math.max((samples.at(-1)?.[0] || 0) - WINDOW, 0), [size, unit] = unitFor(most, 'N');
  const x = time => left + (time - first) / WINDOW * (right - left);
  const y = force => bottom - force / most * (bottom - top);
  if (canvas.width !== Math.round(width * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const paint = canvas.getContext('2d');
  paint.setTransform(ratio, 0, 0, ratio, 0, 0);
  paint.clearRect(0, 0, width, height);
  Object.assign(paint, { font: '11px system-ui, sans-serif', fillStyle: '#5b6875' });
  Object.assign(paint, { strokeStyle: '#d5dbe1', lineWidth: 1, textBaseline: 'middle' });
  const write = (text, px, py, align) => { paint.textAlign = align; paint.fillText(text, px, py); };
  const line = points => {
    paint.beginPath();
    points.forEach(([px, py]) => paint.lineTo(px, py));
    paint.stroke();
  };
  for (const force of [0, 0.5 * most, most]) {
    line([[left, y(force)], [right, y(force)]]);
    write(+(force / size).toPrecision(2), left - 5, y(force), 'right');
  }
  for (let time = Math.ceil(first / 2) * 2; time <= first + WINDOW; time += 2) {
    line([[x(time), bottom], [x(time), bottom + 4]]);
    write(time, x(time), bottom + 11, 'center');
  }
  write('time [s]', (left + right) / 2, height - 6, 'center');
  paint.rotate(-Math.PI / 2);
  write(`force [${unit}]`, -(top + bottom) / 2, 7, 'center');
  paint.rotate(Math.PI / 2);
  Object.assign(paint, { strokeStyle: '#1458c8', lineWidth: 2 });
  line(samples.map(([time, force]) => [x(time), y(force)]));
}

// A dot for each hand, and an arrow of the force of each one that drags.
export function showArrows(svg, hands, scene, longest) {
  const mark = (name, values, text = '') => {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(values)) made.setAttribute(key, value);
    made.textContent = text;
    svg.append(made);
  };
  svg.querySelectorAll(':scope > :not(defs)').forEach(each => each.remove());
  for (const { place, force, dragged } of hands) {
    const size = Math.hypot(...force), [x, y] = scene.project(place);
    mark('circle', { cx: x, cy: y, r: 4 });
    if (!size || !dragged) continue;
    const long = scene.page.size * (0.04 / size + 0.1 / longest);
    const [x2, y2] = scene.project(place.map((from, k) => from + long * force[k]));
    mark('line', { x1: x, y1: y, x2, y2, 'marker-end': 'url(#head)' });
    mark('text', { x: Math.max(x2 + 10, 10), y: Math.max(y2 - 8, 16) }, withUnit(size, 'N'));
  }
}
