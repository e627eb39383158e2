// Contact points of the learned force field and their features, as stages/core/models/field/contact_points.py has them.
// Only points whose gate is open are kept; what has not moved since the last step is kept from it. Part of the worker's
// source.

import { Body } from "player/body.js";
import { Linear3 } from "player/layers.js";

export class Contacts {
  static FULL_CONTACT = 0.04;
  static NO_CONTACT = 0.1;
  static SEARCH_RADIUS = 0.2;
  static PAIR_FRACTION = 0.375;
  static WALL_FRACTION = 0.125;
  static GAP_UNIT = 0.05;
  static ARM_UNIT = 0.3;

  constructor(bodies) {
    this.bodies = bodies;
    this.pairs = new Map(); // own, other -> contact points of `own` with `other`
    this.floor = [];
    this.walls = [];
  }

  key(own, other) { return own * this.bodies.length + other; }

  *of(own) {
    for (let other = 0; other < this.bodies.length; other++) if (other !== own) yield this.pairs.get(this.key(own, other));
  }

  // All contacts at the present positions. A list is `updated` if it was computed now.
  find(gravity) {
    const { bodies, pairs } = this;
    for (let i = 0; i < bodies.length; i++) for (let j = 0; j < i; j++) {
      const lists = [pairs.get(this.key(i, j)), pairs.get(this.key(j, i))];
      if (lists[0] && bodies[i].unchanged && bodies[j].unchanged) {
        for (const list of lists) list.updated = false;
        continue;
      }
      const [a, b] = this.nearestPairs(i, j);
      pairs.set(this.key(i, j), this.pairList(i, j, a, gravity));
      pairs.set(this.key(j, i), this.pairList(j, i, b, gravity));
    }
    bodies.forEach((body, i) => {
      if (this.floor[i] && body.unchanged) {
        this.floor[i].updated = this.walls[i].updated = false;
        return;
      }
      this.floor[i] = this.planeList(i, this.floorPoints(body), gravity);
      this.walls[i] = this.planeList(i, this.wallPoints(body), gravity);
    });
  }

  static gate(x) { // 1 below FULL_CONTACT, exactly 0 above NO_CONTACT, a cubic between
    const s = Math.min(Math.max((Contacts.NO_CONTACT - x) / (Contacts.NO_CONTACT - Contacts.FULL_CONTACT), 0), 1);
    return s * s * (3 - 2 * s);
  }

  // For each point of i within SEARCH_RADIUS of a point of j the nearest such point, [own, partner], and the reverse.
  nearestPairs(i, j) {
    const { bodies } = this, own = this.candidates(bodies[i], bodies[j]), other = this.candidates(bodies[j], bodies[i]);
    const x = bodies[i].points, y = bodies[j].points, limit = Contacts.SEARCH_RADIUS ** 2;
    const best = new Float64Array(other.length).fill(limit), which = new Int32Array(other.length).fill(-1), forward = [], backward = [];
    for (const k of own) {
      let nearest = limit, partner = -1;
      for (let m = 0; m < other.length; m++) {
        const l = other[m], d = (x[3 * k] - y[3 * l]) ** 2 + (x[3 * k + 1] - y[3 * l + 1]) ** 2 + (x[3 * k + 2] - y[3 * l + 2]) ** 2;
        if (d < nearest) { nearest = d; partner = l; }
        if (d < best[m]) { best[m] = d; which[m] = k; }
      }
      if (partner >= 0) forward.push([k, partner]);
    }
    other.forEach((l, m) => { if (which[m] >= 0) backward.push([l, which[m]]); });
    return [forward, backward];
  }

  candidates(body, other) { // points within SEARCH_RADIUS of the other body's box
    const { n, points } = body, r = Contacts.SEARCH_RADIUS, { low, high } = other, out = [];
    for (let a = 0; a < 3; a++) if (body.low[a] >= high[a] + r || body.high[a] <= low[a] - r) return out;
    for (let k = 0; k < n; k++) {
      const x = points[3 * k], y = points[3 * k + 1], z = points[3 * k + 2];
      if (x > low[0] - r && x < high[0] + r && y > low[1] - r && y < high[1] + r && z > low[2] - r && z < high[2] + r) out.push(k);
    }
    return out;
  }

  // The `count` of the entries {..., key} with the smallest keys.
  static smallest(entries, count) {
    return entries.length > count ? entries.sort((a, b) => a.key - b.key).slice(0, count) : entries;
  }

  // Vectors: gap, normals of both, relative velocity of the points, arms of both, relative velocity of the bodies, gravity,
  // and the impulses that would stop the points and that act along the partner's normal.
  pairList(i, j, found, gravity) {
    const a = this.bodies[i], b = this.bodies[j], C = Contacts, entries = [];
    for (const [k, l] of found) {
      let now = 1e-12, ahead = 1e-12;
      for (let c = 0; c < 3; c++) {
        const gap = a.points[3 * k + c] - b.points[3 * l + c], approach = a.pointVelocity[3 * k + c] - b.pointVelocity[3 * l + c];
        now += gap * gap;
        ahead += (gap + Body.FRAME * approach) ** 2;
      }
      now = Math.sqrt(now); ahead = Math.sqrt(ahead);
      if (Math.min(now, ahead) < C.NO_CONTACT) entries.push({ k, l, now, ahead, key: Math.min(now, ahead) });
    }
    const chosen = C.smallest(entries, Math.ceil(C.PAIR_FRACTION * a.n)), list = this.list(i, chosen, 10, 7);
    Object.assign(list, { other: j, gap: new Float64Array(3 * chosen.length) });
    const ratio = Math.max(b.mass, 1e-6) / (Math.max(a.mass, 1e-6) + Math.max(b.mass, 1e-6)), K = new Float64Array(9), { vectors: v } = list;
    chosen.forEach(({ k, l, now, ahead, key }, r) => {
      const at = 30 * r;
      for (let c = 0; c < 3; c++) {
        list.gap[3 * r + c] = a.points[3 * k + c] - b.points[3 * l + c];
        v[at + c] = list.gap[3 * r + c] / C.GAP_UNIT;
        v[at + 3 + c] = a.normalNow[3 * k + c];
        v[at + 6 + c] = b.normalNow[3 * l + c];
        v[at + 9 + c] = a.pointVelocity[3 * k + c] - b.pointVelocity[3 * l + c];
        v[at + 12 + c] = a.armNow[3 * k + c] / C.ARM_UNIT;
        v[at + 15 + c] = b.armNow[3 * l + c] / C.ARM_UNIT;
        v[at + 18 + c] = a.velocity[c] - b.velocity[c];
      }
      v[at + 23] = -gravity / 5;
      K.fill(0);
      Linear3.addImpulseResponse(a.worldInverse, a.armNow, 3 * k, ratio, K);
      Linear3.addImpulseResponse(b.worldInverse, b.armNow, 3 * l, 1 - ratio, K);
      Linear3.solve(K, v, at + 9, v, at + 24);
      Linear3.solve(K, v, at + 6, v, at + 27);
      list.gate[r] = C.gate(key);
      const scalars = [now / C.GAP_UNIT, ahead / C.GAP_UNIT, list.gate[r], a.spacing[k] / C.GAP_UNIT, b.spacing[l] / C.GAP_UNIT];
      list.scalars.set([...scalars, Math.log(a.size), Math.log(b.size)], 7 * r);
    });
    return list;
  }

  list(own, entries, vectorCount, scalarCount) {
    const count = entries.length, { massFraction } = this.bodies[own];
    return {
      own, count, vectorCount, scalarCount, updated: true, row: entries.map(({ k }) => k),
      massFraction: entries.map(({ k }) => massFraction[k]),
      gate: new Float64Array(count), vectors: new Float64Array(3 * vectorCount * count), scalars: new Float64Array(scalarCount * count),
    };
  }

  floorPoints(body) {
    return Array.from({ length: body.n }, (_, k) => ({ k, height: body.points[3 * k + 2] - body.box[2], normal: [0, 0, 1] }));
  }

  // The points nearest to walls or ceiling, each with its nearest plane.
  wallPoints({ n, points, pointVelocity, box, low, high }) {
    const far = Contacts.NO_CONTACT + Body.FRAME * 1e3; // beyond any motion in a frame
    if (low[0] - box[0] > far && low[1] - box[1] > far && [0, 1, 2].every((a) => box[3 + a] - high[a] > far)) return [];
    const planes = [[0, 1], [1, 1], [0, -1], [1, -1], [2, -1]], entries = [];
    for (let k = 0; k < n; k++) {
      let height = Infinity, nearest = null;
      for (const plane of planes) {
        const [axis, sign] = plane, distance = sign * (points[3 * k + axis] - box[sign > 0 ? axis : 3 + axis]);
        if (distance < height) { height = distance; nearest = plane; }
      }
      const [axis, sign] = nearest, normal = [0, 0, 0];
      normal[axis] = sign;
      entries.push({ k, height, normal, key: Math.min(height, height + Body.FRAME * sign * pointVelocity[3 * k + axis]) });
    }
    return Contacts.smallest(entries, Math.ceil(Contacts.WALL_FRACTION * n));
  }

  // Vectors: normal of the plane and of the keypoint, velocity of the point, arm, velocity of the body, gravity, and the
  // impulses that would stop the point and that act along the plane's normal.
  planeList(i, found, gravity) {
    const body = this.bodies[i], C = Contacts, entries = [], K = new Float64Array(9);
    for (const entry of found) {
      const { k, height, normal } = entry, v = body.pointVelocity;
      const ahead = height + Body.FRAME * (v[3 * k] * normal[0] + v[3 * k + 1] * normal[1] + v[3 * k + 2] * normal[2]);
      if (Math.min(height, ahead) < C.NO_CONTACT) entries.push({ ...entry, ahead });
    }
    const list = this.list(i, entries, 8, 5), { vectors: v } = list, clamp = (x) => Math.min(Math.max(x / C.GAP_UNIT, -2), 2);
    entries.forEach(({ k, height, ahead, normal }, r) => {
      const at = 24 * r;
      for (let c = 0; c < 3; c++) {
        v[at + c] = normal[c];
        v[at + 3 + c] = body.normalNow[3 * k + c];
        v[at + 6 + c] = body.pointVelocity[3 * k + c];
        v[at + 9 + c] = body.armNow[3 * k + c] / C.ARM_UNIT;
        v[at + 12 + c] = body.velocity[c];
      }
      v[at + 17] = -gravity / 5;
      K.fill(0);
      Linear3.addImpulseResponse(body.worldInverse, body.armNow, 3 * k, 1, K);
      Linear3.solve(K, v, at + 6, v, at + 18);
      Linear3.solve(K, v, at, v, at + 21);
      list.gate[r] = C.gate(Math.min(height, ahead));
      list.scalars.set([clamp(height), clamp(ahead), list.gate[r], body.spacing[k] / C.GAP_UNIT, Math.log(body.size)], 5 * r);
    });
    return list;
  }
}
