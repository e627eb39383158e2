// Vectors as arrays of three numbers, matrices as rows of nine.

export const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const subtract = (a, b) => add(a, b, -1);
export const scale = (a, s) => [s * a[0], s * a[1], s * a[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (a) => Math.sqrt(dot(a, a));
export const unit = (a) => scale(a, 1 / Math.max(length(a), 1e-12));
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const mix = (a, b, t) => a.map((x, i) => x + t * (b[i] - x));
export const apply = (m, a) => [dot(m.slice(0, 3), a), dot(m.slice(3, 6), a), dot(m.slice(6, 9), a)];

// `a` turned about the unit `axis` by `angle` [rad].
export function turned(a, axis, angle) {
  const c = Math.cos(angle), along = scale(axis, (1 - c) * dot(axis, a));
  return add(add(scale(a, c), cross(axis, a), Math.sin(angle)), along);
}

// `a` turned by the quaternion w x y z.
export function turnedBy([w, x, y, z], a) {
  const t = scale(cross([x, y, z], a), 2);
  return add(add(a, t, w), cross([x, y, z], t));
}
