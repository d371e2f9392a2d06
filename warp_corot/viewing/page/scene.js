// What is drawn: bodies, tools, the ground with their shadow, and the camera. Lengths are in metres.

const FOV = 28 * Math.PI / 180, PITCH = 24 * Math.PI / 180, YAW = Math.atan2(-2.4, 1.6);
// Triangles that meet at a larger angle have an edge between them.
const CREASE = Math.cos(40 * Math.PI / 180);
const LIGHT = [-0.15, -0.38, 0.92];  // along the ground's two axes, and up
const CELLS = 16;  // of the ground's grid, to each side

export const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => { const s = 1 / (Math.hypot(...a) || 1); return [s * a[0], s * a[1], s * a[2]]; };
const combined = (axes, c) => add(add([c[0] * axes[0][0], c[0] * axes[0][1], c[0] * axes[0][2]], axes[1], c[1]), axes[2], c[2]);

// Two axes at right angles to a direction, and the direction.
function axesOf(up) {
  const first = Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
  const x = unit(add(first, up, -dot(first, up)));
  return [x, cross(up, x), up];
}

const SOLID = `#version 300 es
in vec3 place; in vec3 normal; in float shade;
uniform mat4 clip; uniform vec4 turn; uniform vec3 shift; uniform vec4 ground; uniform vec3 light; uniform bool flatten;
out vec3 n; out float s;
vec3 turned(vec3 v) { return v + 2.0 * cross(turn.xyz, cross(turn.xyz, v) + turn.w * v); }
void main() {
  vec3 p = turned(place) + shift;
  if (flatten) p -= (dot(ground.xyz, p) - ground.w) / dot(ground.xyz, light) * light;
  n = turned(normal); s = shade;
  gl_Position = clip * vec4(p, 1.0);
}`;
const LIT = `#version 300 es
precision highp float;
in vec3 n; in float s;
uniform sampler2D colors; uniform vec4 color; uniform bool shaded, flatten; uniform vec3 light, up;
out vec4 result;
void main() {
  if (flatten) { result = color; return; }
  vec3 m = normalize(gl_FrontFacing ? n : -n);
  vec3 c = shaded ? texture(colors, vec2(s, 0.5)).rgb : color.rgb;
  result = vec4(c * (0.8 + 0.06 * dot(m, up) + 0.18 * max(dot(m, light), 0.0)), 1.0);
}`;
const PLANE = `#version 300 es
in vec2 place;
uniform mat4 clip; uniform vec3 center, x, y; uniform float cell;
out float fade;
void main() {
  float r = length(place) / ${CELLS}.0;
  fade = max(1.0 - r * r, 0.0);
  gl_Position = clip * vec4(center + cell * (place.x * x + place.y * y), 1.0);
}`;
const FADING = `#version 300 es
precision highp float;
in float fade; uniform vec4 color; out vec4 result;
void main() { result = vec4(color.rgb, color.a * fade); }`;

// Points of a surface for drawing: a point on an edge is drawn once for each of the smooth parts that meet there.
class Surface {
  constructor(points, triangles) {
    this.points = points; this.triangles = triangles;
    const faces = triangles.length / 3, first = faceNormals(points, triangles);
    const parts = new Map();  // of a point: faces that began a part, and the part's number
    const source = [];
    this.corners = new Uint32Array(triangles.length);
    for (let f = 0; f < faces; f++) for (let c = 0; c < 3; c++) {
      const p = triangles[3 * f + c], known = parts.get(p) || [];
      if (!known.length) parts.set(p, known);
      let part = known.find(([g]) => first[3 * f] * first[3 * g] + first[3 * f + 1] * first[3 * g + 1] + first[3 * f + 2] * first[3 * g + 2] > CREASE);
      if (!part) { part = [f, source.length]; known.push(part); source.push(p); }
      this.corners[3 * f + c] = part[1];
    }
    this.source = Uint32Array.from(source);
    this.places = new Float32Array(3 * source.length);
    this.normals = new Float32Array(3 * source.length);
    this.shades = new Uint8Array(source.length);
    this.update(points);
  }

  update(points, shades) {
    this.points = points; this.isShaded = !!shades;
    const { source, places, normals, corners } = this;
    for (let k = 0; k < source.length; k++) {
      const p = 3 * source[k];
      places[3 * k] = points[p]; places[3 * k + 1] = points[p + 1]; places[3 * k + 2] = points[p + 2];
      if (shades) this.shades[k] = shades[source[k]];
    }
    normals.fill(0);
    const facing = faceNormals(places, corners, false);
    for (let i = 0; i < corners.length; i++) {
      const n = 3 * corners[i], f = 3 * Math.floor(i / 3);
      normals[n] += facing[f]; normals[n + 1] += facing[f + 1]; normals[n + 2] += facing[f + 2];
    }
  }
}

function faceNormals(points, triangles, isUnit = true) {
  const found = new Float32Array(triangles.length);
  for (let i = 0; i < triangles.length; i += 3) {
    const a = 3 * triangles[i], b = 3 * triangles[i + 1], c = 3 * triangles[i + 2];
    const ux = points[b] - points[a], uy = points[b + 1] - points[a + 1], uz = points[b + 2] - points[a + 2];
    const vx = points[c] - points[a], vy = points[c + 1] - points[a + 1], vz = points[c + 2] - points[a + 2];
    let x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    const s = isUnit ? 1 / (Math.hypot(x, y, z) || 1) : 1e6;  // areas of small bodies are beyond half precision
    found[i] = s * x; found[i + 1] = s * y; found[i + 2] = s * z;
  }
  return found;
}

const turnBy = (q, v) => add(v, cross(q, add(cross(q, v), v, q[3])), 2);

export class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    const probe = document.createElement('canvas').getContext('webgl2');
    if (!probe) throw new Error('This browser has no WebGL 2, which the page needs to draw.');
    // Without a graphics card, every pixel takes time from the simulation.
    const info = probe.getExtension('WEBGL_debug_renderer_info');
    this.isSoftware = /swiftshader|llvmpipe|software/i.test(probe.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : probe.RENDERER));
    const gl = this.gl = canvas.getContext('webgl2', { alpha: false, stencil: true, antialias: !this.isSoftware });
    this.solid = this.program(SOLID, LIT);
    this.plane = this.program(PLANE, FADING);
    this.colors = gl.createTexture();
    this.bodies = []; this.solids = []; this.poses = [];
    this.yaw = YAW; this.pitch = PITCH; this.distance = 1; this.target = [0, 0, 0]; this.center = [0, 0];
    this.makeGround();
    this.draw();
  }

  program(vertex, fragment) {
    const gl = this.gl, made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(made, shader);
    }
    ['place', 'normal', 'shade'].forEach((name, k) => gl.bindAttribLocation(made, k, name));
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    const at = {};
    for (let k = 0; k < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(made, k);
      at[name] = gl.getUniformLocation(made, name);
    }
    return { made, at };
  }

  // --- what is there

  makeGround() {
    const gl = this.gl, points = [[0, 0]];
    for (let k = 0; k <= 48; k++) points.push([CELLS * Math.cos(k * Math.PI / 24), CELLS * Math.sin(k * Math.PI / 24)]);
    this.disc = points.length;
    for (let i = -CELLS; i <= CELLS; i++) for (let j = -CELLS; j < CELLS; j++) points.push([i, j], [i, j + 1], [j, i], [j + 1, i]);
    this.lines = points.length - this.disc;
    this.ground = gl.createVertexArray();
    gl.bindVertexArray(this.ground);
    this.fill(gl.createBuffer(), new Float32Array(points.flat()), 0, 2, gl.FLOAT);
  }

  fill(buffer, data, attribute, size, type) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(attribute);
    gl.vertexAttribPointer(attribute, size, type, type === gl.UNSIGNED_BYTE, 0, 0);
  }

  setPage(page) {
    this.page = page;
    if (this.axes) return;
    this.axes = axesOf(page.up);
    const gl = this.gl, table = Uint8Array.from(page.colormap.match(/../g), word => parseInt(word, 16));
    gl.bindTexture(gl.TEXTURE_2D, this.colors);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, table.length / 3, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, table);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
  }

  setTopology(header, parts) {
    const gl = this.gl;
    for (const each of [...this.bodies, ...this.solids]) { gl.deleteVertexArray(each.array); each.buffers.forEach(b => gl.deleteBuffer(b)); }
    const made = parts.map(({ points, triangles }) => {
      const surface = new Surface(points, triangles);
      surface.array = gl.createVertexArray();
      surface.buffers = [0, 1, 2, 3].map(() => gl.createBuffer());
      gl.bindVertexArray(surface.array);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, surface.buffers[3]);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, surface.corners, gl.STATIC_DRAW);
      surface.isNew = true;
      return surface;
    });
    this.bodies = made.slice(0, header.bodies.length);
    this.solids = made.slice(header.bodies.length);
    this.movable = header.movable; this.grounds = header.grounds;
    this.lowest = Infinity;
  }

  setFrame(header, points, shades) {
    this.poses = header.poses;
    this.bodies.forEach((body, k) => { body.update(points[k], shades[k]); body.isNew = true; });
    const up = this.page.up;
    let lowest = Infinity;
    for (const p of points) for (let i = 0; i < p.length; i += 3) lowest = Math.min(lowest, p[i] * up[0] + p[i + 1] * up[1] + p[i + 2] * up[2]);
    // Without a ground, a floor is drawn below everything that has been seen.
    this.lowest = Math.min(this.lowest, lowest);
    const pose = this.poses[this.grounds[0]], normal = pose ? turnBy(pose.slice(3), [0, 0, 1]) : up;
    this.floor = { normal, level: pose ? dot(normal, pose) : this.lowest, axes: axesOf(normal) };
  }

  // --- the camera

  get cell() {  // the edge of the ground's squares: 1, 2 or 5 times a power of ten, about a tenth of the bodies' size
    const wanted = this.page.size / 8, power = 10 ** Math.floor(Math.log10(wanted));
    return power * [1, 2, 5, 10].find(step => step * power >= wanted * 0.999);
  }

  view() {
    const { axes, yaw, pitch } = this, c = Math.cos(pitch);
    const back = combined(axes, [c * Math.cos(yaw), c * Math.sin(yaw), Math.sin(pitch)]);
    const right = unit(cross(axes[2], back));
    return { back, right, up: cross(back, right), eye: add(this.target, back, this.distance) };
  }

  // Pixels in all, and half of them over those of a length of one at a distance of one.
  lens(width = this.canvas.clientWidth, height = this.canvas.clientHeight) {
    const f = 1 / Math.tan(FOV / 2);
    return { width, height, x: f * height / width, y: f };
  }

  fit(clear) {
    if (!this.bodies.length) return;
    const lens = this.lens(), { width, height } = lens;
    this.center = [(clear.left + clear.right) / width - 1, 1 - (clear.top + clear.bottom) / height];
    const half = [(clear.right - clear.left) / width, (clear.bottom - clear.top) / height];
    const points = [...this.bodies.map(body => body.points), ...this.solids.map((_, k) => this.corners(k))];
    const { back, right, up } = this.view();
    const over = visit => { for (const p of points) for (let i = 0; i < p.length; i += 3) visit(add([p[i], p[i + 1], p[i + 2]], this.target, -1)); };
    for (let turn = 0; turn < 8; turn++) {
      let distance = 0;
      over(p => { distance = Math.max(distance, dot(p, back) + Math.max(lens.x * Math.abs(dot(p, right)) / half[0], lens.y * Math.abs(dot(p, up)) / half[1])); });
      this.distance = 1.04 * distance || 1;
      const ends = [Infinity, -Infinity, Infinity, -Infinity];
      over(p => {
        const far = this.distance - dot(p, back), x = dot(p, right) / far, y = dot(p, up) / far;
        ends[0] = Math.min(ends[0], x); ends[1] = Math.max(ends[1], x); ends[2] = Math.min(ends[2], y); ends[3] = Math.max(ends[3], y);
      });
      if (!Number.isFinite(ends[0])) return;
      this.target = add(add(this.target, right, 0.5 * (ends[0] + ends[1]) * this.distance), up, 0.5 * (ends[2] + ends[3]) * this.distance);
    }
  }

  // The points of a solid where it is.
  corners(number) {
    const pose = this.poses[number], { points } = this.solids[number], found = new Float32Array(points.length);
    for (let i = 0; pose && i < points.length; i += 3) found.set(add(turnBy(pose.slice(3), [points[i], points[i + 1], points[i + 2]]), pose), i);
    return found;
  }

  turn(dx, dy) {
    this.yaw -= 0.008 * dx;
    this.pitch = Math.min(Math.max(this.pitch + 0.008 * dy, -1.5), 1.5);
  }

  shift(dx, dy) { this.target = add(this.target, this.motion(this.target, dx, dy), -1); }

  zoom(by) { this.distance *= by; }

  // How far a place goes with the mouse [m].
  motion(place, dx, dy) {
    const { back, right, up, eye } = this.view(), lens = this.lens(), far = dot(add(eye, place, -1), back);
    return add([0, 0, 0].map((_, k) => right[k] * 2 * dx / lens.width / lens.x * far), up, -2 * dy / lens.height / lens.y * far);
  }

  // How far a tool goes with the mouse: upright, so that it meets what stands beside it; seen from above, along the ground.
  slide(place, dx, dy) {
    const { back, eye } = this.view(), upright = add(back, this.axes[2], -dot(back, this.axes[2]));
    const normal = Math.abs(this.pitch) < 0.8 ? upright : this.axes[2], [x, y] = this.project(place), way = this.way(x + dx, y + dy);
    const far = dot(add(place, eye, -1), normal) / dot(way, normal);
    return far > 0 && far < 10 * this.distance ? add(add(eye, way, far), place, -1) : this.motion(place, dx, dy);
  }

  // The direction in which a place in the window is seen.
  way(px, py) {
    const { back, right, up } = this.view(), lens = this.lens();
    const x = (2 * px / lens.width - 1 - this.center[0]) / lens.x, y = (1 - 2 * py / lens.height - this.center[1]) / lens.y;
    return unit(add(add(add([0, 0, 0], right, x), up, y), back, -1));
  }

  // A place that is seen to the left of all bodies, as far away as their middle.
  beside() {
    const { right, back, eye } = this.view(), low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    const over = visit => this.bodies.forEach(({ points }) => { for (let i = 0; i < points.length; i += 3) visit([points[i], points[i + 1], points[i + 2]]); });
    over(p => p.forEach((x, k) => { low[k] = Math.min(low[k], x); high[k] = Math.max(high[k], x); }));
    const middle = low.map((x, k) => 0.5 * (x + high[k])), far = dot(add(eye, middle, -1), back);
    let left = 0;
    over(p => { const q = add(p, middle, -1); left = Math.min(left, dot(q, right) / (1 - dot(q, back) / far)); });
    return add(middle, right, left - 0.15 * this.page.size);
  }

  // Where a place is in the window.
  project(place) {
    const { back, right, up, eye } = this.view(), lens = this.lens(), p = add(place, eye, -1), far = -dot(p, back);
    return [(1 + this.center[0] + lens.x * dot(p, right) / far) / 2 * lens.width, (1 - this.center[1] - lens.y * dot(p, up) / far) / 2 * lens.height];
  }

  // The first thing below a place in the window: {body | tool, at}; null for none.
  pick(px, py) {
    const { eye } = this.view(), way = this.way(px, py);
    let nearest = Infinity, found = null;
    const through = (points, triangles, what) => {
      const far = firstHit(eye, way, points, triangles);
      if (far < nearest) { nearest = far; found = { ...what, at: add(eye, way, far) }; }
    };
    this.bodies.forEach((body, k) => through(body.points, body.triangles, { body: k }));
    this.solids.forEach((solid, k) => this.movable[k] && through(this.corners(k), solid.triangles, { tool: k }));
    return found;
  }

  // --- drawing

  clip(width, height) {
    const { back, right, up, eye } = this.view(), lens = this.lens(width, height), { size } = this.page;
    const near = Math.max(this.distance - 4 * size, 0.02 * this.distance), far = this.distance + 12 * size;
    const rows = [
      [...right.map((r, k) => lens.x * r - this.center[0] * back[k]), 0],
      [...up.map((u, k) => lens.y * u - this.center[1] * back[k]), 0],
      [...back.map(b => -b * (far + near) / (far - near)), -2 * far * near / (far - near)],
      [...back.map(b => -b), 0],
    ].map(row => { row[3] -= dot(row, eye); return row; });
    return new Float32Array([0, 1, 2, 3].flatMap(column => rows.map(row => row[column])));
  }

  draw(width = this.canvas.clientWidth, height = this.canvas.clientHeight, ratio = this.isSoftware ? 1 : Math.min(devicePixelRatio, 2)) {
    const { gl, page, canvas, floor } = this, w = Math.round(width * ratio), h = Math.round(height * ratio);
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    gl.viewport(0, 0, w, h);
    gl.clearColor(0.957, 0.965, 0.973, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    if (!floor) return;
    const clip = this.clip(width, height), light = unit(combined(floor.axes, LIGHT)), { eye } = this.view();
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    const isAbove = dot(eye, floor.normal) > floor.level;
    if (isAbove) this.drawGround(clip, floor);
    const { at } = this.solid;
    gl.useProgram(this.solid.made);
    gl.uniformMatrix4fv(at.clip, false, clip);
    gl.uniform3fv(at.light, light);
    gl.uniform3fv(at.up, floor.normal);
    gl.uniform4f(at.ground, ...floor.normal, floor.level);
    for (const flatten of isAbove ? [true, false] : [false]) {
      gl.uniform1i(at.flatten, flatten);
      (flatten ? gl.enable : gl.disable).call(gl, gl.STENCIL_TEST);
      (flatten ? gl.disable : gl.enable).call(gl, gl.DEPTH_TEST);
      gl.stencilFunc(gl.EQUAL, 0, 255);
      gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
      this.bodies.forEach(body => this.drawSurface(body, [0, 0, 0, 0, 0, 0, 1], flatten ? null : page.tissueColor));
      this.solids.forEach((solid, k) => this.poses[k] && this.drawSurface(solid, this.poses[k], flatten ? null : page.toolColor));
    }
    gl.disable(gl.STENCIL_TEST);
  }

  drawGround(clip, floor) {
    const { gl } = this, { at, made } = this.plane, { cell } = this;
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(made);
    gl.bindVertexArray(this.ground);
    gl.uniformMatrix4fv(at.clip, false, clip);
    // The grid stays where it is; the target is within its middle square.
    const offset = floor.axes.slice(0, 2).map(axis => cell * Math.round(dot(this.target, axis) / cell));
    gl.uniform3fv(at.center, combined(floor.axes, [...offset, floor.level]));
    gl.uniform3fv(at.x, floor.axes[0]);
    gl.uniform3fv(at.y, floor.axes[1]);
    gl.uniform1f(at.cell, cell);
    gl.uniform4f(at.color, 0.85, 0.87, 0.89, 1);
    gl.drawArrays(gl.TRIANGLE_FAN, 0, this.disc);
    gl.uniform4f(at.color, 0.74, 0.77, 0.81, 0.8);
    gl.drawArrays(gl.LINES, this.disc, this.lines);
  }

  drawSurface(surface, pose, color) {
    const { gl } = this, { at } = this.solid;
    if (!surface.corners.length) return;
    gl.bindVertexArray(surface.array);
    if (surface.isNew) {
      this.fill(surface.buffers[0], surface.places, 0, 3, gl.FLOAT);
      this.fill(surface.buffers[1], surface.normals, 1, 3, gl.FLOAT);
      this.fill(surface.buffers[2], surface.shades, 2, 1, gl.UNSIGNED_BYTE);
      surface.isNew = false;
    }
    gl.uniform3f(at.shift, pose[0], pose[1], pose[2]);
    gl.uniform4f(at.turn, pose[3], pose[4], pose[5], pose[6]);
    gl.uniform1i(at.shaded, color && surface.isShaded ? 1 : 0);
    gl.uniform4f(at.color, ...(color || [0.1, 0.12, 0.18]), color ? 1 : 0.26);
    gl.drawElements(gl.TRIANGLES, surface.corners.length, gl.UNSIGNED_INT, 0);
  }
}

// The distance along a ray to the first of the triangles (Möller and Trumbore 1997); infinite if it meets none.
function firstHit(eye, way, points, triangles) {
  let nearest = Infinity;
  for (let i = 0; i < triangles.length; i += 3) {
    const corner = k => { const p = 3 * triangles[i + k]; return [points[p], points[p + 1], points[p + 2]]; };
    const a = corner(0), e1 = add(corner(1), a, -1), e2 = add(corner(2), a, -1), h = cross(way, e2), d = dot(e1, h);
    if (!d) continue;
    const s = add(eye, a, -1), u = dot(s, h) / d, q = cross(s, e1), v = dot(way, q) / d, t = dot(e2, q) / d;
    if (u >= 0 && v >= 0 && u + v <= 1 && t > 0 && t < nearest) nearest = t;
  }
  return nearest;
}
