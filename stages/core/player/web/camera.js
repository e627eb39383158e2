// The camera, x right, y down, z forward, and its control by mouse, touch and keys.

import { add, apply, cross, dot, length, mix, scale, subtract, turned, unit } from "player/vectors.js";

const UP = [0, 0, 1];
const MAX_PITCH = 1.5; // of the viewing axis to the horizontal [rad]
const TRANSITION = 0.35; // [s]
const KEYS = { KeyW: [2, 1], KeyS: [2, -1], KeyA: [0, -1], KeyD: [0, 1], KeyQ: [1, 1], KeyE: [1, -1] }; // axis, sign

export class Camera {
  constructor({ viewmat, K, size }, target) {
    this.set({ viewmat, K, size }, target);
  }

  // The view of a photo or of the file; `target` is turned about, by default a point ahead.
  set({ viewmat, K, size }, target) {
    this.rows = [0, 1, 2].map((i) => viewmat[i].slice(0, 3)); // right, down, forward
    const t = viewmat.slice(0, 3).map((row) => row[3]);
    this.eye = scale(add(add(scale(this.rows[0], t[0]), this.rows[1], t[1]), this.rows[2], t[2]), -1);
    this.lens = { fx: K[0][0], fy: K[1][1], cx: K[0][2], cy: K[1][2], width: size[0], height: size[1] };
    if (target) this.distance = Math.max(dot(subtract(target, this.eye), this.rows[2]), 1e-3);
    this.transition = null;
  }

  get pivot() { return add(this.eye, this.rows[2], this.distance); }

  // What the renderer needs for a picture of this size [px]; the lens's picture fits into it.
  view(width, height) {
    const { fx, fy, cx, cy, width: w, height: h } = this.lens, s = Math.min(width / w, height / h);
    const rotation = this.rows.flat();
    return {
      rotation, translation: scale(apply(rotation, this.eye), -1), eye: this.eye, size: [width, height],
      intrinsics: [s * fx, s * fy, width / 2 + s * (cx - w / 2), height / 2 + s * (cy - h / 2)],
    };
  }

  // The point at a depth that a pixel of a view shows, and the pixel that shows a point.
  static point({ rotation, eye, intrinsics: [fx, fy, cx, cy] }, x, y, depth) {
    const local = [(x - cx) / fx * depth, (y - cy) / fy * depth, depth];
    return add(eye, [0, 1, 2].map((j) => local[0] * rotation[j] + local[1] * rotation[3 + j] + local[2] * rotation[6 + j]));
  }

  static pixel({ rotation, translation, intrinsics: [fx, fy, cx, cy] }, point) {
    const [x, y, z] = add(apply(rotation, point), translation);
    return z > 1e-6 ? [fx * x / z + cx, fy * y / z + cy] : null;
  }

  orbit(dx, dy) { // [rad]
    const pivot = this.pivot, pitch = Math.asin(Math.max(-1, Math.min(1, this.rows[2][2])));
    const down = Math.max(-MAX_PITCH, Math.min(MAX_PITCH, pitch - dy)) - pitch;
    const axis = this.rows[0];
    this.rows = this.rows.map((row) => turned(turned(row, axis, down), UP, -dx));
    this.eye = add(pivot, this.rows[2], -this.distance);
  }

  pan(dx, dy) { // [px of the lens]
    const step = this.distance / this.lens.fx;
    this.eye = add(add(this.eye, this.rows[0], -dx * step), this.rows[1], -dy * step);
  }

  zoom(factor) {
    const pivot = this.pivot;
    this.distance = Math.max(1e-3, this.distance * factor);
    this.eye = add(pivot, this.rows[2], -this.distance);
  }

  walk(keys, seconds) {
    for (const [key, [axis, sign]] of Object.entries(KEYS))
      if (keys.has(key)) this.eye = add(this.eye, this.rows[axis], sign * seconds * 0.8 * this.distance);
  }

  // Turn to a point and turn about it from now on, upright.
  focus(point) {
    this.transition = { from: this.pivot, to: point, time: 0 };
  }

  // Continue a transition and the walk; whether the camera moved.
  advance(seconds, keys) {
    const walking = Object.keys(KEYS).some((key) => keys.has(key));
    if (walking) this.walk(keys, seconds);
    const t = this.transition;
    if (!t) return walking;
    t.time += seconds / TRANSITION;
    const eased = t.time >= 1 ? 1 : 0.5 - 0.5 * Math.cos(Math.PI * t.time);
    this.lookAt(mix(t.from, t.to, eased));
    if (t.time >= 1) this.transition = null;
    return true;
  }

  lookAt(point) {
    const forward = unit(subtract(point, this.eye)), right = unit(cross(forward, UP));
    if (Math.abs(forward[2]) < Math.sin(MAX_PITCH)) this.rows = [right, cross(forward, right), forward];
    this.distance = length(subtract(point, this.eye));
  }
}

// Turn, shift and zoom by pointers; `changed` is called after. `claim(event)` may take a press for itself by returning
// an object with `move(event)` and `end(event)`.
export function controlCamera(element, camera, { changed, claim }) {
  const pointers = new Map();
  let claimed = null;
  const middle = () => {
    const points = [...pointers.values()], sum = points.reduce((a, b) => [a[0] + b[0], a[1] + b[1]], [0, 0]);
    const spread = points.length > 1 ? Math.hypot(points[0][0] - points[1][0], points[0][1] - points[1][1]) : 0;
    return [sum[0] / points.length, sum[1] / points.length, spread];
  };
  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (pointers.size === 1) claimed = claim(event);
  });
  element.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId)) return;
    const [x, y, spread] = middle();
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (claimed) return claimed.move(event);
    const [newX, newY, newSpread] = middle(), dx = newX - x, dy = newY - y;
    const pixels = Math.max(camera.lens.width / element.clientWidth, camera.lens.height / element.clientHeight);
    if (pointers.size > 1) {
      camera.pan(dx * pixels, dy * pixels);
      if (spread && newSpread) camera.zoom(spread / newSpread);
    } else if (event.buttons & 6 || event.shiftKey) camera.pan(dx * pixels, dy * pixels);
    else camera.orbit(6 * dx / element.clientWidth, 4 * dy / element.clientHeight);
    changed();
  });
  for (const kind of ["pointerup", "pointercancel"]) element.addEventListener(kind, (event) => {
    pointers.delete(event.pointerId);
    if (claimed) claimed.end(event);
    claimed = null;
  });
  element.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoom(Math.exp(0.0015 * Math.max(-300, Math.min(300, event.deltaY * (event.deltaMode ? 30 : 1)))));
    changed();
  }, { passive: false });
  element.addEventListener("contextmenu", (event) => event.preventDefault());
}
