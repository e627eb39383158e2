// The learned force field as an engine: frames of a film in scene units, force prompts, and objects that sleep until they
// are touched, as stages/simulate/learned.py and sleep.py have them. Part of the worker's source.

import { Body } from "player/body.js";
import { ForceField } from "player/force_field.js";

export class FieldEngine {
  static KEPT = 10; // frames from one kept state to the next

  // film: `field` and `forces` of its header, objects, dt, rest and object of the keypoints, and the arrays field_* and
  // weights_* (stages/core/player/playable.py)
  constructor({ field, forces, objects, dt, rest, object, arrays }) {
    Object.assign(this, { field, forces, dt, rest, ids: objects.map((o) => o.id) });
    const prefixed = (prefix) => Object.fromEntries(Object.entries(arrays).filter(([name]) => name.startsWith(prefix))
      .map(([name, values]) => [name.slice(prefix.length), values]));
    const given = prefixed("field_"), count = this.ids.length, weights = prefixed("weights_");
    this.rows = this.ids.map((id) => Array.from(object.keys()).filter((k) => object[k] === id)); // keypoints of each object
    this.bodies = this.rows.map((rows, o) => {
      const own = (name, width) => Float64Array.from(rows.flatMap((k) => Array.from(given[name].subarray(width * k, width * (k + 1)))));
      const part = (name) => { const width = given[name].length / count; return Float64Array.from(given[name].subarray(width * o, width * (o + 1))); };
      const [mass, E, solidity, nu, friction, volume] = part("material");
      return new Body({
        points: own("points", 3), massFraction: own("mass_fraction", 1), normal: own("normal", 3), spacing: own("spacing", 1),
        inverse: part("inverse"), keypointInverse: part("keypoint_inverse"), principal: part("principal"),
        box: part("box"), startVelocity: part("velocity"), mass, E, solidity, nu, friction, volume,
      });
    });
    this.model = new ForceField(weights, this.bodies, field.gravity);
    this.materials = this.bodies.map(({ mass, E, nu, friction }) => ({ mass, E, nu, friction }));
    const lift = new Map(forces.filter((f) => f.kind === "lift").map((f) => [f.object_id, f.height]));
    this.lift = this.ids.map((id) => lift.get(id) ?? 0);
    this.sleep = new Sleep(this.bodies, field.awake, field.standing);
    this.given = this.modelForces(forces.filter((f) => (f.kind ?? "force") === "force"));
    this.changes = forces.filter((f) => f.kind === "change");
    this.kept = [];
    this.restart();
  }

  restart() {
    this.frame = 0;
    this.frictionOfAll = this.field.friction;
    this.names = [...this.field.names];
    this.pinned = new Set(this.forces.filter((f) => f.kind === "pin").map((f) => f.object_id));
    this.bodies.forEach((body, o) => {
      body.restart();
      Object.assign(body, this.materials[o]);
      this.model.encode(body);
    });
    this.model.setGravity(this.field.gravity);
    this.gravity = this.field.real_gravity;
    this.sleep.restart();
    this.points = this.bodies.map((body) => Float64Array.from(body.positions()));
    this.first = this.points;
    this.before = this.bodies.map((body) => Float64Array.from(body.given));
  }

  // To a frame of the motion without a user's actions, computed from the start or from the last state that was kept.
  goTo(frame) {
    this.restart();
    const state = this.kept.findLast((s) => s.frame <= frame);
    if (state) {
      this.frame = state.frame;
      for (const change of this.changes) if (change.start < this.frame * this.dt) this.change(change);
      this.bodies.forEach((body, o) => { body.state = state.bodies[o]; });
      this.sleep.asleep = [...state.asleep];
      this.points = this.before = state.points;
    }
    while (this.frame < frame) this.prepare();
  }

  // One frame without a user's actions; some states are kept for `goTo`.
  prepare() {
    this.advance();
    if (this.frame % FieldEngine.KEPT || this.frame <= (this.kept.at(-1)?.frame ?? 0)) return;
    const { frame, bodies, points, sleep } = this;
    this.kept.push({ frame, points, bodies: bodies.map((body) => body.state), asleep: [...sleep.asleep] });
  }

  // Forces in newtons and scene units, at = a point at rest or keypoint = a row, in model units.
  modelForces(forces) {
    const { mass, scale, time } = this.field, newton = mass * scale / time ** 2;
    return forces.map((f) => {
      const body = this.ids.indexOf(f.object_id);
      const point = f.keypoint !== undefined ? this.rows[body].indexOf(f.keypoint) : f.at ? this.nearest(body, f.at) : -1;
      return {
        body, point, force: f.force.map((x) => newton * x), torque: (f.torque ?? [0, 0, 0]).map((x) => newton * scale * x),
        start: f.start * time, end: (f.end ?? Infinity) * time,
      };
    });
  }

  nearest(body, point) { // keypoint of an object nearest to a point at rest
    const { length, origin, floor } = this.field, lifted = [point[0], point[1], point[2] + this.lift[body]];
    const [x, y, z] = lifted.map((v, a) => (v - origin[a]) * length + (a === 2 ? floor : 0)), { given, n } = this.bodies[body];
    const distance = (k) => (given[3 * k] - x) ** 2 + (given[3 * k + 1] - y) ** 2 + (given[3 * k + 2] - z) ** 2;
    return Array.from({ length: n }, (_, k) => k).reduce((best, k) => distance(k) < distance(best) ? k : best, 0);
  }

  // One frame, with the forces and changes of the user.
  advance(forces = [], changes = []) {
    const { model, bodies, field, sleep } = this, start = this.frame * this.dt, end = (this.frame + 1) * this.dt;
    const acting = [...this.given, ...this.modelForces(forces)], seconds = this.dt * field.time / field.steps;
    const all = [...this.changes.filter((c) => start <= c.start && c.start < end), ...changes];
    for (const change of all) this.change(change);
    const pushed = (o) => acting.some((f) => f.body === o && Math.min(f.end, end * field.time) > Math.max(f.start, start * field.time));
    const roused = (id) => all.some((c) => c.what === "gravity" || c.object_id === id);
    sleep.wake(this.ids.map((id, o) => pushed(o) || roused(id)));
    bodies.forEach((body, o) => { body.pinned = this.pinned.has(this.ids[o]) || sleep.asleep[o]; });
    if (!sleep.asleep.every(Boolean)) {
      for (let i = 0; i < field.steps; i++) model.step((this.frame * field.steps + i) * seconds, seconds, acting);
      this.points = bodies.map((body) => body.positions());
      sleep.wakeOnImpact(this.points, this.before, field.steps * seconds);
      this.before = this.points;
    }
    this.frame++;
  }

  change({ what, value, object_id: id }) {
    const { field, bodies, model } = this, o = this.ids.indexOf(id);
    if (what === "pinned") this.pinned[value ? "add" : "delete"](id);
    if (what === "gravity") {
      this.gravity = value;
      model.setGravity(value * field.scale / field.time ** 2);
    }
    if (what === "friction") this.frictionOfAll = value;
    if (what === "material") {
      const { E, density, nu, friction } = field.materials[value], body = bodies[o];
      const stress = field.mass / (field.scale * field.time ** 2);
      this.names[o] = value;
      Object.assign(body, {
        mass: density * body.volume * field.mass, E: Math.max(E * stress, field.min_stiffness / body.solidity), nu, friction,
      });
    }
    if (what !== "friction" && what !== "material") return;
    bodies.forEach((body) => {
      if (this.frictionOfAll !== null) body.friction = this.frictionOfAll;
      model.encode(body);
    });
  }

  // Positions of all keypoints in scene units.
  positions() {
    const out = new Float32Array(this.rest.length);
    this.rows.forEach((rows, o) => rows.forEach((k, row) => {
      for (let a = 0; a < 3; a++)
        out[3 * k + a] = this.rest[3 * k + a] + (a === 2 ? this.lift[o] : 0) + (this.points[o][3 * row + a] - this.first[o][3 * row + a]) / this.field.length;
    }));
    return out;
  }

  // Centres of the objects' masses in scene units.
  centres(positions) {
    const { bodies, rows } = this, centre = (o, a) => rows[o].reduce((sum, k, row) => sum + bodies[o].massFraction[row] * positions[3 * k + a], 0);
    return bodies.map((_, o) => [0, 1, 2].map((a) => centre(o, a)));
  }

  get masses() { return this.bodies.map((body) => body.mass / this.field.mass); } // [kg]
}

// Which objects are at rest and stay until another one hits them.
export class Sleep {
  static CONTACT_DISTANCE = 0.05;
  static INITIAL_CONTACT_DISTANCE = 0.1;
  static WAKE_SPEED = 0.25;

  constructor(bodies, awake, standing) {
    Object.assign(this, { bodies, awake, standing, mass: bodies.map((body) => Math.max(body.mass, 1e-6)) });
    this.spacing = bodies.map(({ given, n }) => {
      const side = (a) => { const x = Array.from({ length: n }, (_, k) => given[3 * k + a]); return Math.max(...x) - Math.min(...x); };
      const [x, y, z] = [0, 1, 2].map(side);
      return Math.sqrt(2 * (x * y + y * z + z * x) / n);
    });
    const points = bodies.map((body) => body.given), near = bodies.map((_, i) => bodies.map((__, j) =>
      i !== j && this.touching(points, i, j, Sleep.INITIAL_CONTACT_DISTANCE, () => true)));
    this.inContact = bodies.map((_, i) => bodies.map((__, j) => near[i][j] || near[j][i]));
    this.restart();
  }

  restart() {
    this.asleep = Array.from(this.awake, (x) => !x);
    this.wakeUnsupported();
  }

  // Whether a keypoint of i that is `chosen` touches object j.
  touching(points, i, j, gap, chosen) {
    const limit = (gap + Math.max(this.spacing[i], this.spacing[j]) / 2) ** 2, x = points[i], y = points[j];
    for (let k = 0; k < x.length; k += 3) {
      if (!chosen(k)) continue;
      for (let l = 0; l < y.length; l += 3)
        if ((x[k] - y[l]) ** 2 + (x[k + 1] - y[l + 1]) ** 2 + (x[k + 2] - y[l + 2]) ** 2 < limit) return true;
    }
    return false;
  }

  wakeOnImpact(points, before, seconds) {
    if (!this.asleep.includes(true)) return;
    const { mass } = this, hit = this.bodies.map((_, j) => this.asleep[j] && this.bodies.some((__, i) => {
      const least = Sleep.WAKE_SPEED * (mass[i] + mass[j]) / mass[i] * seconds;
      const fast = (k) => Math.hypot(points[i][k] - before[i][k], points[i][k + 1] - before[i][k + 1], points[i][k + 2] - before[i][k + 2]) > least;
      return !this.asleep[i] && this.touching(points, i, j, Sleep.CONTACT_DISTANCE, fast);
    }));
    this.wake(hit);
  }

  wake(rows) {
    this.asleep = this.asleep.map((x, o) => x && !rows[o]);
    this.wakeUnsupported();
  }

  wakeUnsupported() { // those that neither stand on the floor nor touch a supported sleeping object
    let supported = this.asleep.map((x, o) => x && Boolean(this.standing[o])), count = -1;
    while (count !== supported.filter(Boolean).length) {
      count = supported.filter(Boolean).length;
      supported = supported.map((x, i) => x || (this.asleep[i] && supported.some((y, j) => y && this.inContact[i][j])));
    }
    this.asleep = supported;
  }
}
