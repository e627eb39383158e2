// Keypoint positions to an affine displacement of the space around each keypoint, as stages/core/physics/skinning.py
// does it. A Gaussian at X bound to keypoints j moves to X + sum w_j (G_j X + c_j). Runs in the worker, whose source is
// made of these functions: they use each other only.

// The rotation nearest to a 3x3 matrix (row after row), into `out`: the largest eigenvector of a 4x4 matrix, as a
// quaternion. Source: Horn 1987, "Closed-form solution of absolute orientation using unit quaternions".
export function nearestRotation(m, out) {
  const a = [
    m[0] + m[4] + m[8], m[7] - m[5], m[2] - m[6], m[3] - m[1],
    m[7] - m[5], m[0] - m[4] - m[8], m[3] + m[1], m[2] + m[6],
    m[2] - m[6], m[3] + m[1], m[4] - m[0] - m[8], m[7] + m[5],
    m[3] - m[1], m[2] + m[6], m[7] + m[5], m[8] - m[0] - m[4],
  ];
  const [w, x, y, z] = largestEigenvector(a);
  out[0] = 1 - 2 * (y * y + z * z); out[1] = 2 * (x * y - w * z); out[2] = 2 * (x * z + w * y);
  out[3] = 2 * (x * y + w * z); out[4] = 1 - 2 * (x * x + z * z); out[5] = 2 * (y * z - w * x);
  out[6] = 2 * (x * z - w * y); out[7] = 2 * (y * z + w * x); out[8] = 1 - 2 * (x * x + y * y);
}

// Unit eigenvector of the largest eigenvalue of a symmetric 4x4 matrix, which is overwritten: Jacobi's method.
export function largestEigenvector(a) {
  const v = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  for (let sweep = 0; sweep < 12; sweep++) {
    let off = 0, on = 0;
    for (let i = 0; i < 4; i++) for (let j = 0; j < 4; j++) if (i === j) on += a[5 * i] ** 2; else off += a[4 * i + j] ** 2;
    if (off <= 1e-30 * on) break;
    for (let p = 0; p < 3; p++) for (let q = p + 1; q < 4; q++) {
      if (a[4 * p + q] === 0) continue;
      const theta = (a[5 * q] - a[5 * p]) / (2 * a[4 * p + q]);
      const t = (theta < 0 ? -1 : 1) / (Math.abs(theta) + Math.sqrt(theta * theta + 1));
      const c = 1 / Math.sqrt(t * t + 1), s = t * c;
      for (let k = 0; k < 4; k++) {
        const ap = a[4 * k + p], aq = a[4 * k + q], vp = v[4 * k + p], vq = v[4 * k + q];
        a[4 * k + p] = c * ap - s * aq; a[4 * k + q] = s * ap + c * aq;
        v[4 * k + p] = c * vp - s * vq; v[4 * k + q] = s * vp + c * vq;
      }
      for (let k = 0; k < 4; k++) {
        const ap = a[4 * p + k], aq = a[4 * q + k];
        a[4 * p + k] = c * ap - s * aq; a[4 * q + k] = s * ap + c * aq;
      }
    }
  }
  let best = 0;
  for (let i = 1; i < 4; i++) if (a[5 * i] > a[5 * best]) best = i;
  return [v[best], v[4 + best], v[8 + best], v[12 + best]];
}

export function inverseOf(m) { // 3x3, row after row
  const [a, b, c, d, e, f, g, h, i] = m;
  const A = e * i - f * h, B = c * h - b * i, C = b * f - c * e;
  const det = a * A + d * B + g * C;
  return [A, B, C, f * g - d * i, a * i - c * g, c * d - a * f, d * h - e * g, b * g - a * h, a * e - b * d]
    .map((x) => x / det);
}

export class Skinning {
  static RIDGE = 1e-3; // weight of a rigid rotation, as in skinning.py

  // rest: p x 3 positions; object: p ids; neighbours: p x j keypoints, padded with the keypoint itself.
  constructor(rest, object, neighbours) {
    const p = object.length, j = p ? neighbours.length / p : 0;
    const ids = [...new Set(object)];
    Object.assign(this, { rest, p, j, neighbours, bodies: ids.length });
    this.body = Int32Array.from(object, (id) => ids.indexOf(id));
    this.ad = new Float64Array(3 * p * j); // weight of a neighbour times its offset
    this.M = new Float64Array(9 * p); // sum of weight d d^T
    this.inverse = new Float64Array(9 * p); // of M with the ridge
    this.ridge = new Float64Array(p);
    const M = new Float64Array(9), square = new Float64Array(j);
    for (let k = 0; k < p; k++) {
      let mean = 0;
      for (let n = 0; n < j; n++) {
        square[n] = [0, 1, 2].reduce((sum, i) => sum + this.offset(rest, k, n, i) ** 2, 0);
        mean += square[n] / j;
      }
      M.fill(0);
      for (let n = 0; n < j; n++) {
        const weight = neighbours[k * j + n] === k ? 0 : 1 / (square[n] + 1e-12 + mean);
        for (let a = 0; a < 3; a++) {
          const ad = this.ad[3 * (k * j + n) + a] = weight * this.offset(rest, k, n, a);
          for (let b = 0; b < 3; b++) M[3 * a + b] += ad * this.offset(rest, k, n, b);
        }
      }
      this.M.set(M, 9 * k);
      this.ridge[k] = Skinning.RIDGE / 3 * Math.max(M[0] + M[4] + M[8], 1e-12);
      for (const i of [0, 4, 8]) M[i] += this.ridge[k];
      this.inverse.set(inverseOf(M), 9 * k);
    }
  }

  offset(x, k, n, axis) { // from keypoint k to its neighbour n
    return x[3 * this.neighbours[k * this.j + n] + axis] - x[3 * k + axis];
  }

  // For each keypoint the rows (G, c) of its affine displacement, 12 numbers.
  motion(positions) {
    const { p, j, rest, neighbours, ad } = this, out = new Float32Array(12 * p);
    const u = Float64Array.from(positions, (x, i) => x - rest[i]);
    const whole = this.bodyRotations(u);
    const relative = new Float64Array(9), blended = new Float64Array(9), R = new Float64Array(9), G = new Float64Array(9);
    for (let k = 0; k < p; k++) {
      relative.fill(0);
      for (let n = k * j; n < (k + 1) * j; n++) {
        const other = 3 * neighbours[n];
        for (let a = 0; a < 3; a++) {
          const du = u[other + a] - u[3 * k + a];
          for (let b = 0; b < 3; b++) relative[3 * a + b] += du * ad[3 * n + b];
        }
      }
      G.fill(0);
      if (relative.some((x) => x !== 0)) {
        const ridge = this.ridge[k], body = 9 * this.body[k];
        for (let i = 0; i < 9; i++) blended[i] = this.M[9 * k + i] + relative[i] + 0.3 * ridge * whole[body + i];
        nearestRotation(blended, R);
        for (const i of [0, 4, 8]) R[i] -= 1;
        for (let a = 0; a < 3; a++) for (let b = 0; b < 3; b++) for (let c = 0; c < 3; c++)
          G[3 * a + b] += (relative[3 * a + c] + ridge * R[3 * a + c]) * this.inverse[9 * k + 3 * c + b];
      }
      for (let a = 0; a < 3; a++) {
        let c = u[3 * k + a];
        for (let b = 0; b < 3; b++) {
          out[12 * k + 4 * a + b] = G[3 * a + b];
          c -= G[3 * a + b] * rest[3 * k + b];
        }
        out[12 * k + 4 * a + 3] = c;
      }
    }
    return out;
  }

  // Rotation of each object that best maps its keypoints, as fit_rotations in skinning.py.
  bodyRotations(u) {
    const { p, rest, body, bodies } = this;
    const size = new Float64Array(bodies), X = new Float64Array(3 * bodies), x = new Float64Array(3 * bodies);
    for (let k = 0; k < p; k++) {
      size[body[k]]++;
      for (let a = 0; a < 3; a++) {
        X[3 * body[k] + a] += rest[3 * k + a];
        x[3 * body[k] + a] += rest[3 * k + a] + u[3 * k + a];
      }
    }
    const H = new Float64Array(9 * bodies), out = new Float64Array(9 * bodies);
    let spread = 0;
    for (let k = 0; k < p; k++) {
      const at = 3 * body[k], arm = (sums, a, moved) => rest[3 * k + a] + moved * u[3 * k + a] - sums[at + a] / size[body[k]];
      for (let b = 0; b < 3; b++) {
        const D = arm(X, b, 0);
        spread += D * D;
        for (let a = 0; a < 3; a++) H[3 * at + 3 * a + b] += arm(x, a, 1) * D;
      }
    }
    for (let o = 0; o < bodies; o++) {
      for (const i of [0, 4, 8]) H[9 * o + i] += 1e-6 * (spread / Math.max(p, 1) + 1e-12);
      nearestRotation(H.subarray(9 * o, 9 * o + 9), out.subarray(9 * o, 9 * o + 9));
    }
    return out;
  }
}
