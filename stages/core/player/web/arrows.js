// Arrows of the forces, drawn over the picture without occlusion; as stages/render/overlay.py draws them.

import { Camera } from "player/camera.js";
import { add, mix, scale, subtract, turnedBy, length } from "player/vectors.js";

const MAX_LENGTH = 1.6; // of the arrow of the largest force [radii of its object]

// Start and end points of the arrows of the forces active at a fractional frame of a film.
export function filmArrows(film, frame) {
  const time = frame * film.dt, first = Math.floor(frame), last = Math.min(first + 1, film.frames - 1);
  const at = (values, width, row) => {
    const get = (t) => Array.from(values.subarray(width * (t * film.objects.length + row), width * (t * film.objects.length + row + 1)));
    return mix(get(first), get(last), frame - first);
  };
  const forces = (film.forces || []).filter((f) => (f.kind || "force") === "force" && length(f.force) > 0);
  const largest = Math.max(...forces.map((f) => length(f.force)));
  return forces.filter((f) => f.start <= time && time < (f.end ?? Infinity)).map((f) => {
    const row = film.objects.findIndex((o) => o.id === f.object_id), own = ownKeypoints(film, f.object_id);
    let start = at(film.arrays.com, 3, row);
    if (f.at) {
      const shift = scale(own.reduce((sum, k) => add(sum, subtract(keypoint(film, 1, k), keypoint(film, 0, k))), [0, 0, 0]), 1 / own.length);
      const com = Array.from(film.arrays.com.subarray(3 * row, 3 * row + 3));
      const q = at(film.arrays.rotation, 4, row), norm = Math.hypot(...q);
      start = add(start, turnedBy(q.map((x) => x / norm), subtract(f.at, subtract(com, shift))));
    }
    return [start, add(start, f.force, MAX_LENGTH * radius(film, own) / largest)];
  });
}

function ownKeypoints(film, id) {
  return Array.from(film.arrays.keypoint_object.keys()).filter((k) => film.arrays.keypoint_object[k] === id);
}

function keypoint(film, row, k) { // row 0 is the rest frame
  const p = film.arrays.keypoint_object.length;
  return Array.from(film.arrays.keypoints.subarray(3 * (row * p + k), 3 * (row * p + k + 1)));
}

function radius(film, own) {
  const points = own.map((k) => keypoint(film, 0, k));
  const side = (i) => Math.max(...points.map((p) => p[i])) - Math.min(...points.map((p) => p[i]));
  return length([side(0), side(1), side(2)]) / 2;
}

// The arrows in a view as data of an SVG path; those behind the camera are left out.
export function arrowPath(view, arrows) {
  return arrows.map(([start, end]) => {
    const a = Camera.pixel(view, start), b = Camera.pixel(view, end);
    if (!a || !b) return "";
    const angle = Math.atan2(b[1] - a[1], b[0] - a[0]), head = Math.min(14, 0.4 * Math.hypot(b[0] - a[0], b[1] - a[1]));
    const [left, right] = [-0.5, 0.5].map((side) => [b[0] - head * Math.cos(angle + side), b[1] - head * Math.sin(angle + side)]);
    return `M${a} L${b} M${left} L${b} L${right}`;
  }).join(" ");
}
