// Layers, vectors and matrices for the learned force field (force_field.js). The worker's source is made of these classes.

// Layers of the network: y = W x + b for `rows` rows, with SiLU between layers.
export class Layers {
  // weights: {name: Float32Array}; names of the layers without ".weight" and ".bias"
  constructor(weights, ...names) {
    this.layers = names.map((name) => {
      const b = Float64Array.from(weights[`${name}.bias`]), w = Float64Array.from(weights[`${name}.weight`]);
      return { w, b, out: b.length, inner: w.length / b.length };
    });
    this.buffers = [];
  }

  get width() { return this.layers.at(-1).out; }

  // x: rows x inner; offset: added to the output of the first layer, one row for all; the result is overwritten by the
  // next call.
  apply(x, rows, offset = null) {
    this.layers.forEach((layer, i) => {
      let y = this.buffers[i];
      if (!y || y.length < rows * layer.out) y = this.buffers[i] = new Float64Array(rows * layer.out);
      if (i) Layers.silu(x, rows * layer.inner);
      Layers.linear(layer, x, rows, y);
      if (!i && offset) for (let r = 0, k = 0; r < rows; r++) for (let j = 0; j < layer.out; j++) y[k++] += offset[j];
      x = y;
    });
    return x;
  }

  static linear({ w, b, out, inner }, x, rows, y) {
    let r = 0;
    for (; r + 4 <= rows; r += 4) { // four rows at once: each weight is read once for them
      const p = r * inner, q = p + inner, s = q + inner, t = s + inner;
      for (let j = 0, k = 0; j < out; j++) {
        let a0 = b[j], a1 = a0, a2 = a0, a3 = a0;
        for (let i = 0; i < inner; i++, k++) {
          const v = w[k];
          a0 += v * x[p + i]; a1 += v * x[q + i]; a2 += v * x[s + i]; a3 += v * x[t + i];
        }
        y[r * out + j] = a0; y[(r + 1) * out + j] = a1; y[(r + 2) * out + j] = a2; y[(r + 3) * out + j] = a3;
      }
    }
    for (; r < rows; r++) for (let j = 0, k = 0; j < out; j++) {
      let a = b[j];
      for (let i = 0; i < inner; i++) a += w[k++] * x[r * inner + i];
      y[r * out + j] = a;
    }
  }

  static silu(x, count) {
    for (let i = 0; i < count; i++) x[i] /= 1 + Math.exp(-x[i]);
  }
}

// Vectors of three numbers and 3x3 matrices (row after row) within arrays, from position i on.
export class Linear3 {
  static response = new Float64Array(9);

  static matvec(m, x, out, i = 0, j = 0) {
    const a = x[i], b = x[i + 1], c = x[i + 2];
    out[j] = m[0] * a + m[1] * b + m[2] * c;
    out[j + 1] = m[3] * a + m[4] * b + m[5] * c;
    out[j + 2] = m[6] * a + m[7] * b + m[8] * c;
  }

  static times(m, x) {
    const out = [0, 0, 0];
    Linear3.matvec(m, x, out);
    return out;
  }

  static square(x, i) { return x[i] * x[i] + x[i + 1] * x[i + 1] + x[i + 2] * x[i + 2]; }

  // Angular velocity of an angular momentum per unit of mass; `inverse` is that of the inertia at rest.
  static spin(inverse, momentum, R) {
    return Linear3.times(R, Linear3.times(inverse, Linear3.times(Linear3.transposed(R), momentum)));
  }

  static transposed(m) { return [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]]; }

  static product(a, b) {
    const out = new Float64Array(9);
    for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++)
      out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
    return out;
  }

  static rotation(q) { // of a quaternion w x y z
    const n = Math.hypot(...q), [w, x, y, z] = q.map((v) => v / n);
    return [
      1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ];
  }

  static rotated([w, x, y, z], r) { // a quaternion after a further rotation vector [rad]
    const half = Math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + 1e-24) / 2, s = Math.sin(half) / (2 * half);
    const c = Math.cos(half), a = s * r[0], b = s * r[1], d = s * r[2];
    const q = [c * w - a * x - b * y - d * z, c * x + a * w + b * z - d * y, c * y + b * w + d * x - a * z, c * z + d * w + a * y - b * x];
    const n = Math.hypot(...q);
    return q.map((v) => v / n);
  }

  // Velocity change of a point at `arm` per unit impulse on it and unit mass, times `factor`, added to K.
  static addImpulseResponse(inverse, arm, i, factor, K) {
    const x = arm[i], y = arm[i + 1], z = arm[i + 2], A = Linear3.response;
    for (let r = 0; r < 9; r += 3) { // rows of the inverse inertia x arm
      A[r] = inverse[r + 1] * z - inverse[r + 2] * y;
      A[r + 1] = inverse[r + 2] * x - inverse[r] * z;
      A[r + 2] = inverse[r] * y - inverse[r + 1] * x;
    }
    for (let c = 0; c < 3; c++) { // arm x columns of that
      K[c] += factor * ((c === 0) - (y * A[6 + c] - z * A[3 + c]));
      K[3 + c] += factor * ((c === 1) - (z * A[c] - x * A[6 + c]));
      K[6 + c] += factor * ((c === 2) - (x * A[3 + c] - y * A[c]));
    }
  }

  // M^-1 x into out, by Cramer's rule as symmetric_solve does it.
  static solve(M, x, i, out, j) {
    const [a, b, c, d, e, f, g, h, k] = M, u = x[i], v = x[i + 1], w = x[i + 2];
    const bc = [e * k - f * h, f * g - d * k, d * h - e * g], ca = [h * c - k * b, k * a - g * c, g * b - h * a];
    const ab = [b * f - c * e, c * d - a * f, a * e - b * d], det = a * bc[0] + b * bc[1] + c * bc[2];
    for (let n = 0; n < 3; n++) out[j + n] = (u * bc[n] + v * ca[n] + w * ab[n]) / det;
  }
}
