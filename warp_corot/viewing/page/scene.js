// What is drawn: bodies, tools, the ground with their shadow, and the camera. Lengths are in metres.

import { Surface, add, cross, dot, firstHit, forEachPoint, turned, unit } from './surface.js';

const FOV = 28 * Math.PI / 180, PITCH = 24 * Math.PI / 180, YAW = Math.atan2(-2.4, 1.6);
const LIGHT = [-0.15, -0.38, 0.92];  // where it comes from, along the ground's two axes and up
const CELLS = 16;  // of the ground's grid, to each side
const AT_HOME = [0, 0, 0, 0, 0, 0, 1];  // the pose of bodies

const SOLID = `#version 300 es
in vec3 place; in vec3 normal; in float shade;
uniform mat4 clip; uniform vec4 turn, ground; uniform vec3 shift, light; uniform bool flatten;
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
uniform sampler2D colors; uniform vec4 color, ground; uniform bool shaded, flatten; uniform vec3 light;
out vec4 result;
void main() {
  if (flatten) { result = color; return; }
  vec3 m = normalize(gl_FrontFacing ? n : -n), c = shaded ? texture(colors, vec2(s, 0.5)).rgb : color.rgb;
  result = vec4(c * (0.8 + 0.06 * dot(m, ground.xyz) + 0.18 * max(dot(m, light), 0.0)), 1.0);
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

const combined = (axes, c) => axes.reduce((sum, axis, k) => add(sum, axis, c[k]), [0, 0, 0]);

// Two axes at right angles to a direction, and the direction.
function axesOf(up) {
  const first = Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], x = unit(add(first, up, -dot(first, up)));
  return [x, cross(up, x), up];
}

export class Scene {
  constructor(canvas) {
    const probe = document.createElement('canvas').getContext('webgl2');
    if (!probe) throw new Error('This browser has no WebGL 2, which the page needs to draw.');
    // Without a graphics card, every pixel takes time from the simulation.
    const info = probe.getExtension('WEBGL_debug_renderer_info');
    const name = probe.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : probe.RENDERER);
    this.isSoftware = /swiftshader|llvmpipe|software/i.test(name);
    this.canvas = canvas;
    this.gl = canvas.getContext('webgl2', { alpha: false, stencil: true, antialias: !this.isSoftware });
    this.solid = this.program(SOLID, LIT);
    this.plane = this.program(PLANE, FADING);
    Object.assign(this, { bodies: [], solids: [], poses: [], yaw: YAW, pitch: PITCH, distance: 1 });
    Object.assign(this, { target: [0, 0, 0], center: [0, 0] });  // the latter: where that is seen
    this.makeGround();
    this.draw();
  }

  program(vertex, fragment) {
    const { gl } = this, made = gl.createProgram(), at = {};
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    ['place', 'normal', 'shade'].forEach((name, k) => gl.bindAttribLocation(made, k, name));
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    for (let k = 0; k < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(made, k);
      at[name] = gl.getUniformLocation(made, name);
    }
    return { made, at };
  }

  fill(buffer, data, attribute, size, type) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(attribute);
    gl.vertexAttribPointer(attribute, size, type, type === gl.UNSIGNED_BYTE, 0, 0);
  }

  // --- what is there

  makeGround() {
    const { gl } = this, points = [[0, 0]];
    for (let k = 0; k <= 48; k++) {
      points.push([CELLS * Math.cos(k * Math.PI / 24), CELLS * Math.sin(k * Math.PI / 24)]);
    }
    this.disc = points.length;
    for (let i = -CELLS; i <= CELLS; i++) {
      for (let j = -CELLS; j < CELLS; j++) points.push([i, j], [i, j + 1], [j, i], [j + 1, i]);
    }
    this.lines = points.length - this.disc;
    this.ground = gl.createVertexArray();
    gl.bindVertexArray(this.ground);
    this.fill(gl.createBuffer(), new Float32Array(points.flat()), 0, 2, gl.FLOAT);
  }

  setPage(page) {
    const { gl } = this;
    this.page = page;
    if (this.axes) return;
    this.axes = axesOf(page.up);
    const table = Uint8Array.from(page.colormap.match(/../g), word => parseInt(word, 16));
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, table.length / 3, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, table);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  }

  setTopology(header, parts) {
    const { gl } = this;
    for (const { array, buffers } of [...this.bodies, ...this.solids]) {
      gl.deleteVertexArray(array);
      buffers.forEach(buffer => gl.deleteBuffer(buffer));
    }
    const made = parts.map(({ points, triangles }) => {
      const surface = new Surface(points, triangles), buffers = [0, 1, 2, 3].map(() => gl.createBuffer());
      const array = gl.createVertexArray();
      gl.bindVertexArray(array);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers[3]);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, surface.corners, gl.STATIC_DRAW);
      return Object.assign(surface, { array, buffers });
    });
    this.bodies = made.slice(0, header.bodies.length);
    this.solids = made.slice(header.bodies.length);
    Object.assign(this, { movable: header.movable, grounds: header.grounds, lowest: Infinity });
  }

  setFrame(header, points, shades) {
    const { up } = this.page;
    this.poses = header.poses;
    this.bodies.forEach((body, k) => body.update(points[k], shades[k]));
    // Without a ground, a floor is drawn below everything that has been seen.
    for (const each of points) forEachPoint(each, p => { this.lowest = Math.min(this.lowest, dot(p, up)); });
    const pose = this.poses[this.grounds[0]], normal = pose ? turned(pose.slice(3), [0, 0, 1]) : up;
    this.floor = { normal, level: pose ? dot(normal, pose) : this.lowest, axes: axesOf(normal) };
  }

  // --- the camera

  get cell() {  // the edge of the ground's squares: 1, 2 or 5 times a power of ten, about an eighth of the bodies' size
    const wanted = this.page.size / 8, power = 10 ** Math.floor(Math.log10(wanted));
    return power * [1, 2, 5, 10].find(step => step * power >= wanted * 0.999);
  }

  view() {
    const { axes, yaw, pitch } = this, flat = Math.cos(pitch);
    const back = combined(axes, [flat * Math.cos(yaw), flat * Math.sin(yaw), Math.sin(pitch)]);
    const right = unit(cross(axes[2], back));
    return { back, right, up: cross(back, right), eye: add(this.target, back, this.distance) };
  }

  // Pixels, and the scale of each direction in a picture from -1 to 1 at a distance of one.
  lens(width = this.canvas.clientWidth, height = this.canvas.clientHeight) {
    const scale = 1 / Math.tan(FOV / 2);
    return { width, height, x: scale * height / width, y: scale };
  }

  // Bring everything into the part of the window that nothing covers.
  fit(clear) {
    const lens = this.lens(), { back, right, up } = this.view();
    const half = { x: (clear.right - clear.left) / lens.width, y: (clear.bottom - clear.top) / lens.height };
    this.center = [(clear.left + clear.right) / lens.width - 1, 1 - (clear.top + clear.bottom) / lens.height];
    const seen = [], see = points => forEachPoint(points, p => seen.push([right, up, back].map(axis => dot(axis, p))));
    this.bodies.forEach(body => see(body.points));
    this.solids.forEach((solid, k) => see(solid.at(this.poses[k])));
    if (!seen.length) return;
    let target = [dot(this.target, right), dot(this.target, up), dot(this.target, back)];
    for (let round = 0; round < 8; round++) {
      const apart = seen.map(p => add(p, target, -1));
      const needs = ([x, y, z]) => z + Math.max(lens.x * Math.abs(x) / half.x, lens.y * Math.abs(y) / half.y);
      this.distance = 1.04 * apart.reduce((most, p) => Math.max(most, needs(p)), 0) || 1;
      const middle = axis => {
        const [low, high] = apart.reduce(([least, most], p) => {
          const place = p[axis] / (this.distance - p[2]);
          return [Math.min(least, place), Math.max(most, place)];
        }, [Infinity, -Infinity]);
        return 0.5 * (low + high) * this.distance;
      };
      target = add(target, [middle(0), middle(1), 0]);
    }
    this.target = combined([right, up, back], target);
  }

  turn(dx, dy) {
    this.yaw -= 0.008 * dx;
    this.pitch = Math.min(Math.max(this.pitch + 0.008 * dy, -1.5), 1.5);
  }

  shift(dx, dy) { this.target = add(this.target, this.motion(this.target, dx, dy), -1); }

  zoom(by) { this.distance *= by; }

  // How far a place goes with the mouse, at the same distance [m].
  motion(place, dx, dy) {
    const { back, right, up, eye } = this.view(), lens = this.lens(), far = 2 * dot(add(eye, place, -1), back);
    return combined([right, up], [far * dx / lens.width / lens.x, -far * dy / lens.height / lens.y]);
  }

  // The same of a tool: upright, so that it meets what stands beside it; seen from above, along the ground.
  slide(place, dx, dy) {
    const { back, eye } = this.view(), up = this.axes[2], [x, y] = this.project(place), way = this.way(x + dx, y + dy);
    const normal = Math.abs(this.pitch) < 0.8 ? add(back, up, -dot(back, up)) : up;
    const far = dot(add(place, eye, -1), normal) / dot(way, normal);
    const isThere = far > 0 && far < 10 * this.distance;
    return isThere ? add(add(eye, way, far), place, -1) : this.motion(place, dx, dy);
  }

  // Where a place is in the window.
  project(place) {
    const { back, right, up, eye } = this.view(), lens = this.lens(), p = add(place, eye, -1), far = -dot(p, back);
    const x = this.center[0] + lens.x * dot(p, right) / far, y = this.center[1] + lens.y * dot(p, up) / far;
    return [0.5 * (1 + x) * lens.width, 0.5 * (1 - y) * lens.height];
  }

  // The direction in which a place in the window is seen.
  way(px, py) {
    const { back, right, up } = this.view(), lens = this.lens();
    const x = 2 * px / lens.width - 1 - this.center[0], y = 1 - 2 * py / lens.height - this.center[1];
    return unit(combined([right, up, back], [x / lens.x, y / lens.y, -1]));
  }

  // A place that is seen to the left of all bodies, as far away as their middle.
  beside() {
    const { right, back, eye } = this.view(), low = [0, 0, 0].fill(Infinity), high = [0, 0, 0].fill(-Infinity);
    const over = visit => this.bodies.forEach(({ points }) => forEachPoint(points, visit));
    over(p => p.forEach((x, k) => { low[k] = Math.min(low[k], x); high[k] = Math.max(high[k], x); }));
    const middle = low.map((x, k) => 0.5 * (x + high[k])), far = dot(add(eye, middle, -1), back);
    let left = 0;
    over(p => {
      const apart = add(p, middle, -1);
      left = Math.min(left, dot(apart, right) / (1 - dot(apart, back) / far));
    });
    return add(middle, right, left - 0.15 * this.page.size);
  }

  // The first thing below a place in the window: {body | tool, at}; null for none.
  pick(px, py) {
    const { eye } = this.view(), way = this.way(px, py), hits = [];
    const meet = (what, points, { triangles }) => hits.push({ ...what, far: firstHit(eye, way, points, triangles) });
    this.bodies.forEach((surface, body) => meet({ body }, surface.points, surface));
    this.solids.forEach((solid, tool) => this.movable[tool] && meet({ tool }, solid.at(this.poses[tool]), solid));
    const first = hits.reduce((nearest, hit) => hit.far < nearest.far ? hit : nearest, { far: Infinity });
    return first.far < Infinity ? { ...first, at: add(eye, way, first.far) } : null;
  }

  // --- drawing

  clip(width, height) {
    const { back, right, up, eye } = this.view(), lens = this.lens(width, height), { size } = this.page;
    const near = Math.max(this.distance - 4 * size, 0.02 * this.distance), far = this.distance + 12 * size;
    const row = (direction, last) => [...direction, last - dot(direction, eye)];
    const rows = [
      row(combined([right, back], [lens.x, -this.center[0]]), 0),
      row(combined([up, back], [lens.y, -this.center[1]]), 0),
      row(combined([back], [-(far + near) / (far - near)]), -2 * far * near / (far - near)),
      row(combined([back], [-1]), 0),
    ];
    return new Float32Array([0, 1, 2, 3].flatMap(column => rows.map(each => each[column])));
  }

  draw(width = this.canvas.clientWidth, height = this.canvas.clientHeight, ratio = devicePixelRatio) {
    const { gl, canvas, floor } = this, w = Math.round(width * ratio), h = Math.round(height * ratio);
    if (canvas.width !== w || canvas.height !== h) Object.assign(canvas, { width: w, height: h });
    gl.viewport(0, 0, w, h);
    gl.clearColor(0.957, 0.965, 0.973, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    if (!floor) return;
    const clip = this.clip(width, height), isAbove = dot(this.view().eye, floor.normal) > floor.level;
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    if (isAbove) this.drawGround(clip);
    const { at, made } = this.solid;
    gl.useProgram(made);
    gl.uniformMatrix4fv(at.clip, false, clip);
    gl.uniform3fv(at.light, unit(combined(floor.axes, LIGHT)));
    gl.uniform4f(at.ground, ...floor.normal, floor.level);
    if (isAbove) this.drawSurfaces(true);
    gl.enable(gl.DEPTH_TEST);
    this.drawSurfaces(false);
    gl.disable(gl.DEPTH_TEST);
  }

  drawGround(clip) {
    const { gl, cell, floor } = this, { at, made } = this.plane;
    gl.useProgram(made);
    gl.bindVertexArray(this.ground);
    gl.uniformMatrix4fv(at.clip, false, clip);
    // The grid stays where it is; the target is within its middle square.
    const middle = [0, 1].map(k => cell * Math.round(dot(this.target, floor.axes[k]) / cell));
    gl.uniform3fv(at.center, combined(floor.axes, [...middle, floor.level]));
    gl.uniform3fv(at.x, floor.axes[0]);
    gl.uniform3fv(at.y, floor.axes[1]);
    gl.uniform1f(at.cell, cell);
    gl.uniform4f(at.color, 0.85, 0.87, 0.89, 1);
    gl.drawArrays(gl.TRIANGLE_FAN, 0, this.disc);
    gl.uniform4f(at.color, 0.74, 0.77, 0.81, 0.8);
    gl.drawArrays(gl.LINES, this.disc, this.lines);
  }

  // All surfaces, or their shadow on the ground: each pixel of that once, by the stencil.
  drawSurfaces(flatten) {
    const { gl, page } = this;
    gl.uniform1i(this.solid.at.flatten, flatten);
    if (flatten) gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.EQUAL, 0, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    const shadow = flatten && [0.1, 0.12, 0.18, 0.26];
    this.bodies.forEach(body => this.drawSurface(body, AT_HOME, shadow || [...page.tissueColor, 1]));
    this.solids.forEach((solid, k) => this.drawSurface(solid, this.poses[k], shadow || [...page.toolColor, 1]));
    gl.disable(gl.STENCIL_TEST);
  }

  drawSurface(surface, pose, color) {
    const { gl } = this, { at } = this.solid, { places, normals, shades, buffers, corners } = surface;
    if (!pose || !corners.length) return;
    gl.bindVertexArray(surface.array);
    if (surface.isNew) {
      this.fill(buffers[0], places, 0, 3, gl.FLOAT);
      this.fill(buffers[1], normals, 1, 3, gl.FLOAT);
      this.fill(buffers[2], shades, 2, 1, gl.UNSIGNED_BYTE);
      surface.isNew = false;
    }
    gl.uniform3f(at.shift, pose[0], pose[1], pose[2]);
    gl.uniform4f(at.turn, pose[3], pose[4], pose[5], pose[6]);
    gl.uniform1i(at.shaded, surface.isShaded);
    gl.uniform4fv(at.color, color);
    gl.drawElements(gl.TRIANGLES, corners.length, gl.UNSIGNED_INT, 0);
  }
}
