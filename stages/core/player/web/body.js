// A body of the learned force field: rest shape, material and state; stages/core/models/field/{rest_shape,rigid_body,
// deformation}.py. Lengths and times are in units of the model. Part of the worker's source.

import { Linear3 } from "player/layers.js";

export class Body {
  static FRAME = 0.02; // time between frames of the training data
  static RADII = [0.12, 0.4]; // of the neighbourhoods [radii of gyration]
  static MIN_NEIGHBOUR_WEIGHT = 1e-9; // relative to the point's own; rounding in the engine is larger
  static MAX_DISPLACEMENT = 1.5; // of a keypoint [radii of gyration]
  static MAX_SPEED = 8;
  static MAX_SPIN = 60;
  static MAX_PENETRATION = 0.03;
  static MAX_RECOVERY_SPEED = 1;
  static FRICTION_CUTOFF_SPEED = 0.3;

  // given: points, massFraction, normal, spacing, inverse, keypointInverse, principal, box (low, high),
  // mass, E, solidity, nu, friction, velocity
  constructor(given) {
    Object.assign(this, given, { given: given.points, n: given.massFraction.length, pinned: false });
    this.start = this.centre(given.points);
    this.arm = Float64Array.from(given.points, (x, i) => x - this.start[i % 3]);
    let square = 0;
    for (let k = 0; k < this.n; k++) square += this.massFraction[k] * Linear3.square(this.arm, 3 * k);
    this.size = Math.sqrt(Math.max(square, 1e-8));
    for (const name of ["u", "du", "armNow", "points", "pointVelocity", "normalNow", "local", "internal"])
      this[name] = new Float64Array(3 * this.n);
    this.low = new Float64Array(3);
    this.high = new Float64Array(3);
    this.restart();
  }

  centre(points) { // weighted by mass
    const out = [0, 0, 0];
    for (let i = 0; i < points.length; i++) out[i % 3] += this.massFraction[(i - i % 3) / 3] * points[i];
    return out;
  }

  restart() {
    this.com = [...this.start];
    this.quat = [1, 0, 0, 0];
    this.velocity = [...this.startVelocity];
    this.momentum = [0, 0, 0];
    this.u.fill(0);
    this.du.fill(0);
    this.changed();
  }

  changed() { // the state was set from outside
    this.unchanged = this.wasPinned = false;
    this.updateKinematics();
  }

  get state() {
    const { com, quat, velocity, momentum, u, du } = this;
    return { com: [...com], quat, velocity, momentum, u: u.slice(), du: du.slice() };
  }

  set state({ com, quat, velocity, momentum, u, du }) {
    Object.assign(this, { com: [...com], quat, velocity, momentum });
    this.u.set(u);
    this.du.set(du);
    this.changed();
  }

  stop() { // a pinned body
    this.velocity = [0, 0, 0];
    this.momentum = [0, 0, 0];
    this.du.fill(0);
  }

  // dt of motion without forces.
  drift(dt) {
    const spin = Linear3.spin(this.inverse, this.momentum, Linear3.rotation(this.quat));
    const middle = Linear3.rotated(this.quat, spin.map((x) => dt / 2 * x));
    const half = Linear3.spin(this.inverse, this.momentum, Linear3.rotation(middle));
    this.quat = Linear3.rotated(this.quat, half.map((x) => dt * x));
    for (let a = 0; a < 3; a++) this.com[a] += dt * this.velocity[a];
    for (let i = 0; i < 3 * this.n; i++) this.u[i] += dt * this.du[i];
    this.bound(this.u, Body.MAX_DISPLACEMENT * this.size);
  }

  // Positions, velocities and normals of the keypoints in the world, and their bounding box.
  updateKinematics() {
    const { n, com, armNow, points, pointVelocity } = this, R = this.R = Linear3.rotation(this.quat);
    this.worldInverse = Linear3.product(Linear3.product(R, this.inverse), Linear3.transposed(R));
    const [sx, sy, sz] = this.spin = Linear3.spin(this.inverse, this.momentum, R), [vx, vy, vz] = this.velocity;
    const rest = new Float64Array(3), turned = new Float64Array(3);
    this.low.fill(Infinity);
    this.high.fill(-Infinity);
    for (let i = 0; i < 3 * n; i += 3) {
      for (let a = 0; a < 3; a++) rest[a] = this.arm[i + a] + this.u[i + a];
      Linear3.matvec(R, rest, armNow, 0, i);
      Linear3.matvec(R, this.du, turned, i, 0);
      Linear3.matvec(R, this.normal, this.normalNow, i, i);
      const x = armNow[i], y = armNow[i + 1], z = armNow[i + 2];
      pointVelocity[i] = vx + sy * z - sz * y + turned[0];
      pointVelocity[i + 1] = vy + sz * x - sx * z + turned[1];
      pointVelocity[i + 2] = vz + sx * y - sy * x + turned[2];
      for (let a = 0; a < 3; a++) {
        const p = points[i + a] = com[a] + armNow[i + a];
        if (p < this.low[a]) this.low[a] = p;
        if (p > this.high[a]) this.high[a] = p;
      }
    }
  }

  // Positions of the keypoints now; those of `points` are of the middle of the last step.
  positions() {
    const { n, com, arm, u } = this, R = Linear3.rotation(this.quat), out = new Float64Array(3 * n);
    for (let i = 0; i < 3 * n; i += 3) {
      const x = arm[i] + u[i], y = arm[i + 1] + u[i + 1], z = arm[i + 2] + u[i + 2];
      for (let a = 0; a < 3; a++) out[i + a] = com[a] + R[3 * a] * x + R[3 * a + 1] * y + R[3 * a + 2] * z;
    }
    return out;
  }

  // Velocities after dt of the accelerations `force`, `torque` and `internal`, with friction below `frictionSpeed`.
  accelerate(dt, force, torque, frictionSpeed) {
    const spinBefore = this.spin, before = this.velocity, norm = (x) => Math.hypot(...x);
    let momentum = this.momentum.map((x, a) => x + dt * torque[a]), velocity = before.map((x, a) => x + dt * force[a]);
    let spin = Linear3.spin(this.inverse, momentum, this.R);
    const slower = Body.MAX_SPIN / Math.max(norm(spin), Body.MAX_SPIN), clamp = Body.MAX_SPEED / Math.max(norm(velocity), Body.MAX_SPEED);
    momentum = momentum.map((x) => slower * x);
    spin = spin.map((x) => slower * x);
    velocity = velocity.map((x) => clamp * x);
    const speed = (v, w) => Linear3.square(v, 0) + this.size ** 2 * Linear3.square(w, 0);
    const mean = (a, b) => a.map((x, i) => (x + b[i]) / 2);
    const net = speed(mean(before, velocity), mean(spinBefore, spin)), last = speed(velocity, spin);
    const moving = (net + (last / Body.FRICTION_CUTOFF_SPEED) ** 2) ** 2 + 1e-16;
    const factor = moving / (moving + dt / Body.FRAME * frictionSpeed ** 4);
    this.momentum = momentum.map((x) => factor * x);
    this.velocity = this.aboveFloor(velocity.map((x) => factor * x), spin.map((x) => factor * x), dt / 2);
    const k = this.stiffness, c = this.damping;
    for (let i = 0; i < 3 * this.n; i++)
      this.du[i] = (this.du[i] + dt * (this.internal[i] - k * this.u[i])) / (1 + dt * c + dt * dt / 2 * k);
    this.bound(this.du, Body.MAX_DISPLACEMENT * this.size * Body.MAX_SPEED);
  }

  // The velocity with which no keypoint gets deeper than MAX_PENETRATION into floor, walls or ceiling within dt.
  aboveFloor(velocity, [sx, sy, sz], dt) {
    const lowest = [Infinity, Infinity, Infinity], highest = [-Infinity, -Infinity, -Infinity], { armNow, points, box } = this;
    for (let i = 0; i < 3 * this.n; i += 3) {
      const x = armNow[i], y = armNow[i + 1], z = armNow[i + 2];
      const ahead = [points[i] + dt * (sy * z - sz * y), points[i + 1] + dt * (sz * x - sx * z), points[i + 2] + dt * (sx * y - sy * x)];
      for (let a = 0; a < 3; a++) {
        if (ahead[a] < lowest[a]) lowest[a] = ahead[a];
        if (ahead[a] > highest[a]) highest[a] = ahead[a];
      }
    }
    return velocity.map((v, a) => {
      const up = Math.min((box[a] - Body.MAX_PENETRATION - lowest[a]) / dt, Body.MAX_RECOVERY_SPEED);
      const down = Math.max((box[3 + a] + Body.MAX_PENETRATION - highest[a]) / dt, -Body.MAX_RECOVERY_SPEED);
      return Math.min(Math.max(v, up), down);
    });
  }

  // A vector field without its mean and its net rotation.
  project(field) {
    const { n, massFraction, arm } = this, mean = [0, 0, 0], angular = [0, 0, 0];
    for (let i = 0; i < 3 * n; i++) mean[i % 3] += massFraction[(i - i % 3) / 3] * field[i];
    for (let i = 0; i < 3 * n; i++) field[i] -= mean[i % 3];
    for (let i = 0; i < 3 * n; i += 3) {
      const m = massFraction[i / 3];
      angular[0] += m * (arm[i + 1] * field[i + 2] - arm[i + 2] * field[i + 1]);
      angular[1] += m * (arm[i + 2] * field[i] - arm[i] * field[i + 2]);
      angular[2] += m * (arm[i] * field[i + 1] - arm[i + 1] * field[i]);
    }
    const [x, y, z] = Linear3.times(this.keypointInverse, angular);
    for (let i = 0; i < 3 * n; i += 3) {
      field[i] -= y * arm[i + 2] - z * arm[i + 1];
      field[i + 1] -= z * arm[i] - x * arm[i + 2];
      field[i + 2] -= x * arm[i + 1] - y * arm[i];
    }
  }

  bound(field, maximum) { // the whole field is scaled
    let largest = 0;
    for (let i = 0; i < field.length; i += 3) largest = Math.max(largest, Linear3.square(field, i));
    const factor = maximum / Math.max(Math.sqrt(largest), maximum);
    if (factor < 1) for (let i = 0; i < field.length; i++) field[i] *= factor;
  }

  // Averaging weights of the neighbourhoods: for each radius the neighbours of each point, from `first` on, and their
  // weights, which sum to 1; computed when first needed.
  get blur() {
    if (this.neighbourhoods) return this.neighbourhoods;
    const { n, arm, massFraction } = this;
    this.neighbourhoods = Body.RADII.map((radius) => {
      const squared = (radius * this.size) ** 2, first = new Int32Array(n + 1), which = [], weight = [];
      for (let k = 0; k < n; k++) {
        let sum = 0;
        for (let j = 0; j < n; j++) {
          const d = (arm[3 * k] - arm[3 * j]) ** 2 + (arm[3 * k + 1] - arm[3 * j + 1]) ** 2 + (arm[3 * k + 2] - arm[3 * j + 2]) ** 2;
          const w = Math.exp(-d / squared);
          if (w < Body.MIN_NEIGHBOUR_WEIGHT) continue;
          which.push(j);
          sum += weight[weight.push(w * massFraction[j]) - 1];
        }
        first[k + 1] = which.length;
        for (let i = first[k]; i < first[k + 1]; i++) weight[i] /= Math.max(sum, 1e-12);
      }
      return { first, which: Int32Array.from(which), weight: Float32Array.from(weight) };
    });
    return this.neighbourhoods;
  }
}
