// The worker: moves the Gaussians' centres with the keypoints and sorts them by depth, far to near.

import { Skinning, inverseOf, largestEigenvector, nearestRotation } from "player/skinning.js";

export function startWorker() {
  return workerOf([nearestRotation, largestEigenvector, inverseOf, Skinning, displace, farToNear, serve], "serve");
}

// A worker made from the source of the functions and classes that it needs, of which it calls `main`: a page opened as a
// file cannot load a worker's script.
export function workerOf(source, main) {
  return new Worker(URL.createObjectURL(new Blob([[...source, `${main}()`].join("\n")], { type: "text/javascript" })));
}

function serve() {
  let film, moved, skinning;
  self.onmessage = ({ data }) => {
    if (data.film) {
      film = data.film;
      moved = film.means.slice();
      if (film.rest) skinning = new Skinning(film.rest, film.object, film.neighbours);
      return;
    }
    let motion = null, spheres = null;
    if (data.positions) {
      motion = skinning.motion(data.positions);
      displace(film, motion, moved);
      if (film.spheres) {
        spheres = film.spheres.means.slice();
        displace(film.spheres, motion, spheres);
      }
    }
    const { order, near, far } = farToNear(moved, data.depthRow, data.nearest);
    self.postMessage({ order, near, far, motion, spheres }, motion ? [order.buffer, motion.buffer] : [order.buffer]);
  };
}

// The centres of the Gaussians that follow keypoints: X + sum w (G X + c), into `moved`.
function displace({ means, index, weight }, motion, moved) {
  const count = weight.length / 8, row = new Float64Array(12);
  for (let i = 0; i < count; i++) {
    row.fill(0);
    for (let j = 8 * i; j < 8 * i + 8; j++) {
      const w = weight[j], k = 12 * index[j];
      if (w) for (let c = 0; c < 12; c++) row[c] += w * motion[k + c];
    }
    const X = means[3 * i], Y = means[3 * i + 1], Z = means[3 * i + 2];
    moved[3 * i] = X + row[0] * X + row[1] * Y + row[2] * Z + row[3];
    moved[3 * i + 1] = Y + row[4] * X + row[5] * Y + row[6] * Z + row[7];
    moved[3 * i + 2] = Z + row[8] * X + row[9] * Y + row[10] * Z + row[11];
  }
}

// Rows of the points deeper than `nearest`, far to near, and the depths between which 96 % of them lie.
// Radix sort: the bits of positive floats sort as whole numbers.
function farToNear(points, [a, b, c, d], nearest) {
  const n = points.length / 3, depth = new Float32Array(n), key = new Uint32Array(depth.buffer);
  const rows = new Uint32Array(n);
  let count = 0;
  for (let i = 0; i < n; i++) {
    depth[i] = a * points[3 * i] + b * points[3 * i + 1] + c * points[3 * i + 2] + d;
    if (depth[i] >= nearest && depth[i] < 1e10) rows[count++] = i;
  }
  let from = rows.subarray(0, count), to = new Uint32Array(count);
  for (const shift of [0, 11, 22]) {
    const start = new Uint32Array(2049);
    for (let i = 0; i < count; i++) start[2048 - ((key[from[i]] >>> shift) & 2047)]++;
    for (let i = 1; i < 2049; i++) start[i] += start[i - 1];
    for (let i = 0; i < count; i++) {
      const digit = (key[from[i]] >>> shift) & 2047;
      to[start[2047 - digit]++] = from[i];
    }
    [from, to] = [to, from];
  }
  const at = (fraction) => count ? depth[from[Math.round(fraction * (count - 1))]] : 1;
  return { order: from, near: at(0.98), far: at(0.02) };
}
