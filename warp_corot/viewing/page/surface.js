// Vectors, and triangulated surfaces: their points for drawing, and where rays meet them.

// Triangles that meet at a larger angle have an edge between them.
const CREASE = Math.cos(40 * Math.PI / 180);

export const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const unit = a => add([0, 0, 0], a, 1 / (Math.hypot(...a) || 1));
// A vector turned by a quaternion (x, y, z, w).
export const turned = (q, v) => add(v, cross(q, add(cross(q, v), v, q[3])), 2);

export function forEachPoint(points, visit) {
  for (let i = 0; i < points.length; i += 3) visit([points[i], points[i + 1], points[i + 2]], i);
}

// Normals of triangles: unit vectors, or as long as their areas in other units, so that small bodies have some.
function faceNormals(points, triangles, areUnits) {
  const found = new Float32Array(triangles.length);
  for (let i = 0; i < triangles.length; i += 3) {
    const a = 3 * triangles[i], b = 3 * triangles[i + 1], c = 3 * triangles[i + 2];
    const ux = points[b] - points[a], uy = points[b + 1] - points[a + 1], uz = points[b + 2] - points[a + 2];
    const vx = points[c] - points[a], vy = points[c + 1] - points[a + 1], vz = points[c + 2] - points[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    const s = areUnits ? 1 / (Math.hypot(x, y, z) || 1) : 1e6;
    found[i] = s * x;
    found[i + 1] = s * y;
    found[i + 2] = s * z;
  }
  return found;
}

// The points of a surface are drawn once, and those on its edges once for each smooth part that meets there.
export class Surface {
  constructor(points, triangles) {
    this.triangles = triangles;
    const normals = faceNormals(points, triangles, true), normal = face => normals.subarray(3 * face, 3 * face + 3);
    const parts = new Map(), source = [];  // for each point: the first triangles of its parts, and the parts' numbers
    this.corners = triangles.map((point, corner) => {
      const face = Math.floor(corner / 3), known = parts.get(point) || [];
      let part = known.find(([first]) => dot(normal(first), normal(face)) > CREASE);
      if (!part) {
        part = [face, source.length];
        source.push(point);
        parts.set(point, [...known, part]);
      }
      return part[1];
    });
    this.source = Uint32Array.from(source);
    this.places = new Float32Array(3 * source.length);
    this.normals = new Float32Array(3 * source.length);
    this.shades = new Uint8Array(source.length);
    this.update(points, null);
  }

  update(points, shades) {
    const { source, places, normals, corners } = this;
    Object.assign(this, { points, isShaded: shades !== null, isNew: true });
    for (let k = 0; k < source.length; k++) {
      for (let n = 0; n < 3; n++) places[3 * k + n] = points[3 * source[k] + n];
      if (shades) this.shades[k] = shades[source[k]];
    }
    const facing = faceNormals(places, corners, false);
    normals.fill(0);
    for (let i = 0; i < corners.length; i++) {
      for (let n = 0; n < 3; n++) normals[3 * corners[i] + n] += facing[3 * Math.floor(i / 3) + n];
    }
  }

  // The points at a pose: position and quaternion.
  at(pose) {
    const found = new Float32Array(this.points.length);
    forEachPoint(this.points, (p, i) => found.set(add(turned(pose.slice(3), p), pose), i));
    return found;
  }
}

// The distance along a ray to the first of the triangles (Möller and Trumbore 1997); infinite if it meets none.
export function firstHit(eye, way, points, triangles) {
  let nearest = Infinity;
  for (let i = 0; i < triangles.length; i += 3) {
    const [a, b, c] = [0, 1, 2].map(k => points.subarray(3 * triangles[i + k], 3 * triangles[i + k] + 3));
    const e1 = add(b, a, -1), e2 = add(c, a, -1), h = cross(way, e2), d = dot(e1, h);
    if (!d) continue;
    const s = add(eye, a, -1), u = dot(s, h) / d, q = cross(s, e1), v = dot(way, q) / d, far = dot(e2, q) / d;
    if (u >= 0 && v >= 0 && u + v <= 1 && far > 0) nearest = Math.min(nearest, far);
  }
  return nearest;
}
