// The learned force field: its step as stages/core/models/field/force_field.py computes it, in numbers of 64 bits. What
// cannot change a result is skipped: forces on pinned bodies, and contacts between bodies that have not moved. Part of
// the worker's source.

import { Body } from "player/body.js";
import { Contacts } from "player/contacts.js";
import { Layers, Linear3 } from "player/layers.js";

export class ForceField {
  static MAX_TRAINED_STIFFNESS = 3.2e5;
  static MAX_TRAINED_SOLID_STIFFNESS = 3e4;
  static MAX_ELASTIC_STIFFNESS = 1e4;
  static ELASTIC_STIFFNESS_RATIO = 4;
  static MAX_STIFFNESS = 2500;
  static MAX_DAMPING = 100;
  static MAX_SPRING_WEIGHT = 8;
  static MAX_DAMPER_WEIGHT = 0.8;
  static MAX_FRICTION_SPEED = 0.07;
  static SEPARATION_SPEED = 0.5;
  static ACCELERATION_UNIT = 20;
  static CONTACT_SATURATION = 2e-3;

  // weights: {name: Float32Array}; bodies: of class Body; gravity: downwards
  constructor(weights, bodies, gravity) {
    const layers = (...names) => new Layers(weights, ...names), mlp = (name) => layers(`${name}.0`, `${name}.2`);
    const contact = (name) => ({
      message: layers(`${name}.input_layer`, `${name}.message.0`, `${name}.message.2`), own: layers(`${name}.own_projection`),
      partner: weights[`${name}.partner_projection.weight`] && layers(`${name}.partner_projection`),
      context: layers(`${name}.context_projection`), decoder: mlp(`${name}.decoder`),
    });
    Object.assign(this, { bodies, gravity, pairs: contact("pairs"), planes: contact("planes"), contacts: new Contacts(bodies) });
    Object.assign(this, {
      keypointEncoder: mlp("keypoint_encoder"), objectEncoder: mlp("object_encoder"), objectUpdate: mlp("object_update"),
      pairUpdate: mlp("pair_update"), planeUpdate: mlp("plane_update"), friction: layers("friction"),
    });
    this.deformation = {
      layers: layers("deformation.input_layer", "deformation.decoder.0", "deformation.decoder.2"),
      embedding: layers("deformation.embedding_projection"), springConstants: mlp("deformation.spring_constants"),
    };
    this.width = this.objectUpdate.width;
    for (const body of bodies) this.encode(body);
  }

  // Embedding and springs of a body, from its shape and material; again after a change of material.
  encode(body) {
    const F = ForceField, { n, size, mass, E, solidity, nu, friction, arm, normal, spacing, principal } = body;
    const unit = Math.max(mass, 1e-6) / Math.max(size, 1e-6), effective = E * solidity;
    const clamped = Math.min(effective, Math.max(E, F.MAX_TRAINED_SOLID_STIFFNESS * unit), F.MAX_TRAINED_STIFFNESS * unit);
    const features = [
      Math.log(size), Math.log10(clamped) - 5, nu, friction, Math.log(Math.max(mass, 1e-6)),
      Math.log(clamped * size / Math.max(mass, 1e-6)) / 5, ...Array.from(principal, (x) => Math.log(x * size * size)),
    ];
    const x = new Float64Array(13 * n), h = this.width, pooled = new Float64Array(2 * h).fill(-Infinity, h);
    for (let k = 0; k < n; k++) {
      const i = 3 * k, inner = arm[i] * normal[i] + arm[i + 1] * normal[i + 1] + arm[i + 2] * normal[i + 2];
      x.set([Math.sqrt(Linear3.square(arm, i)) / size, Math.sqrt(Linear3.square(normal, i)), inner / size, spacing[k] / size, ...features], 13 * k);
    }
    const encoded = this.keypointEncoder.apply(x, n);
    for (let k = 0; k < n; k++) for (let j = 0; j < h; j++) {
      pooled[j] += body.massFraction[k] * encoded[h * k + j];
      pooled[h + j] = Math.max(pooled[h + j], encoded[h * k + j]);
    }
    const sigmoid = (y) => 1 / (1 + Math.exp(-y)), embedding = body.embedding = this.objectEncoder.apply(pooled, 1).slice(0, h);
    const offset = (layers) => layers.apply(embedding, 1).slice(0, h);
    const [stiffness, damping] = this.deformation.springConstants.apply(embedding, 1);
    const elastic = Math.min(F.ELASTIC_STIFFNESS_RATIO * E / unit, F.MAX_ELASTIC_STIFFNESS) * (1 - 1 / solidity);
    Object.assign(body, {
      compliance: clamped / effective, stiffness: F.MAX_STIFFNESS * sigmoid(stiffness) + elastic, damping: F.MAX_DAMPING * sigmoid(damping),
      offsets: {
        own: offset(this.pairs.own), partner: offset(this.pairs.partner), plane: offset(this.planes.own),
        deformation: offset(this.deformation.embedding),
      },
      unchanged: false,
    });
  }

  setGravity(gravity) {
    this.gravity = gravity;
    for (const body of this.bodies) body.unchanged = false;
  }

  // From t to t + dt. forces: [{body, force, torque, start, end, point}], where point is a keypoint of the body or -1.
  step(t, dt, forces) {
    const { bodies } = this;
    for (const body of bodies) {
      const unchanged = body.pinned && body.wasPinned;
      if (body.pinned) body.stop(); else body.drift(dt / 2);
      if (!unchanged) body.updateKinematics();
      body.unchanged = unchanged && body.unchanged;
      body.wasPinned = body.pinned;
    }
    const rates = this.accelerations(t, dt, forces);
    bodies.forEach((body, i) => {
      body.unchanged = body.pinned;
      if (body.pinned) return;
      body.accelerate(dt, rates[i].force, rates[i].torque, rates[i].frictionSpeed);
      body.drift(dt / 2);
    });
  }

  // Accelerations by contact, gravity and `forces`, with the friction threshold; internal accelerations go to
  // body.internal.
  accelerations(t, dt, forces) {
    const rates = this.contactEffects();
    for (const { body, force, torque, start, end, point } of forces) {
      const on = Math.max(0, Math.min(end, t + dt) - Math.max(start, t)) / dt, { mass, armNow } = this.bodies[body];
      if (!on) continue;
      const [fx, fy, fz] = force, [x, y, z] = point < 0 ? [0, 0, 0] : armNow.subarray(3 * point, 3 * point + 3);
      const moment = [y * fz - z * fy, z * fx - x * fz, x * fy - y * fx];
      for (let a = 0; a < 3; a++) {
        rates[body].force[a] += on * force[a] / Math.max(mass, 1e-6);
        rates[body].torque[a] += on * (torque[a] + moment[a]) / Math.max(mass, 1e-6);
      }
    }
    this.bodies.forEach((body, i) => {
      rates[i].force[2] -= this.gravity;
      if (!body.pinned) this.deform(body);
    });
    return rates;
  }

  // One round of messages between bodies, floor and walls; forces per unit of mass, accelerations of keypoints in body.local.
  contactEffects() {
    const { bodies, contacts } = this, h = this.width, zero = new Float64Array(h);
    contacts.find(this.gravity);
    for (const list of contacts.pairs.values())
      if (list.updated) this.encodeContacts(this.pairs, list, this.sum(bodies[list.own].offsets.own, bodies[list.other].offsets.partner));
    for (const list of [...contacts.floor, ...contacts.walls])
      if (list.updated) this.encodeContacts(this.planes, list, bodies[list.own].offsets.plane);
    const rates = bodies.map((body, i) => {
      const messages = [...contacts.of(i)].reduce((sum, list) => this.sum(sum, list.mean), zero);
      const plane = this.sum(contacts.floor[i].mean ?? zero, contacts.walls[i].mean ?? zero);
      const status = this.objectUpdate.apply(Float64Array.of(...body.embedding, ...messages, ...plane), 1).slice(0, h);
      const own = ForceField.MAX_FRICTION_SPEED / (1 + Math.exp(-this.friction.apply(status, 1)[0])) * contacts.floor[i].total;
      body.local.fill(0);
      return { force: [0, 0, 0], torque: [0, 0, 0], status, own, frictionSpeed: own };
    });
    for (const list of contacts.pairs.values()) {
      const { own, other } = list, a = bodies[own], b = bodies[other];
      rates[own].frictionSpeed = Math.max(rates[own].frictionSpeed, list.total * rates[other].own);
      if (!list.count || (a.pinned && b.pinned)) continue;
      const back = contacts.pairs.get(contacts.key(other, own)).mean ?? zero;
      const context = this.pairUpdate.apply(Float64Array.of(...list.mean, ...back, ...rates[own].status, ...rates[other].status), 1);
      this.applyPairForces(list, a, b, this.decode(this.pairs, list, context), rates);
    }
    bodies.forEach((body, i) => {
      for (const list of [contacts.floor[i], contacts.walls[i]]) {
        if (!list.count || body.pinned) continue;
        const context = this.planeUpdate.apply(Float64Array.of(...list.mean, ...rates[i].status), 1);
        this.applyPlaneForces(list, body, this.decode(this.planes, list, context), rates[i]);
      }
      for (let k = 0; k < 3 * body.n; k++) body.local[k] /= Math.max(body.massFraction[(k - k % 3) / 3], 1e-9);
    });
    return rates;
  }

  sum(a, b) { return a.map((x, i) => x + b[i]); }

  // Messages and weights of contact points, and the mean message.
  encodeContacts(net, list, offset) {
    const { count, gate, massFraction } = list, h = this.width, out = net.message.width;
    list.mean = new Float64Array(h);
    list.total = 0;
    if (!count) return;
    const x = net.message.apply(this.features(list), count, offset);
    list.message = new Float64Array(count * h);
    list.weight = new Float64Array(count);
    for (let r = 0; r < count; r++) {
      for (let j = 0; j < h; j++) list.message[r * h + j] = x[r * out + j];
      list.total += list.weight[r] = gate[r] * massFraction[r] * Math.exp(4 * Math.tanh(x[r * out + h] / 4));
    }
    const scale = 1 / (list.total + ForceField.CONTACT_SATURATION);
    list.total *= scale;
    for (let r = 0; r < count; r++) {
      const w = list.weight[r] *= scale;
      for (let j = 0; j < h; j++) list.mean[j] += w * list.message[r * h + j];
    }
  }

  // Inner products of the vectors, compressed, before the scalars.
  features({ count, vectors, scalars, vectorCount: k, scalarCount: s }) {
    const width = k * (k + 1) / 2 + s, x = new Float64Array(count * width);
    for (let r = 0, at = 0; r < count; r++) {
      at = ForceField.innerProducts(vectors, 3 * k * r, k, x, at);
      for (let i = 0; i < s; i++) x[at++] = scalars[r * s + i];
    }
    return x;
  }

  static innerProducts(v, from, k, out, at) {
    for (let i = from; i < from + 3 * k; i += 3) for (let j = i; j < from + 3 * k; j += 3)
      out[at++] = Math.asinh(v[i] * v[j] + v[i + 1] * v[j + 1] + v[i + 2] * v[j + 2]);
    return at;
  }

  // Acceleration of the body by each contact point, times its weight.
  decode(net, list, context) {
    const { count, message, weight, vectors, vectorCount: k } = list, h = this.width, x = message.slice(), out = new Float64Array(3 * count);
    const offset = net.context.apply(context, 1);
    for (let i = 0; i < x.length; i++) x[i] += offset[i % h];
    Layers.silu(x, x.length);
    const coefficients = net.decoder.apply(x, count);
    for (let r = 0; r < count; r++) for (let v = 0; v < k; v++) {
      const c = weight[r] * ForceField.ACCELERATION_UNIT * coefficients[r * k + v];
      for (let a = 0; a < 3; a++) out[3 * r + a] += c * vectors[3 * (r * k + v) + a];
    }
    return out;
  }

  // The forces of a pair on both bodies, at the middles of the gaps.
  applyPairForces(list, a, b, acceleration, rates) {
    const inverse = (body) => body.pinned ? 0 : 1 / Math.max(body.mass, 1e-6);
    const reduced = 1 / Math.max(inverse(a) + inverse(b), 1e-9), massA = Math.max(a.mass, 1e-6), massB = Math.max(b.mass, 1e-6);
    for (let r = 0; r < list.count; r++) {
      const k = 3 * list.row[r], at = 3 * r, F = [0, 1, 2].map((c) => reduced * acceleration[at + c]);
      const middle = [0, 1, 2].map((c) => a.points[k + c] - list.gap[at + c] / 2);
      this.apply(rates[list.own], F, middle, a.com, 1 / massA);
      this.apply(rates[list.other], F, middle, b.com, -1 / massB);
      for (let c = 0; c < 3; c++) a.local[k + c] += F[c] / massA;
    }
  }

  apply(rate, [fx, fy, fz], point, com, factor) {
    const x = point[0] - com[0], y = point[1] - com[1], z = point[2] - com[2], { force, torque } = rate;
    force[0] += factor * fx; force[1] += factor * fy; force[2] += factor * fz;
    torque[0] += factor * (y * fz - z * fy); torque[1] += factor * (z * fx - x * fz); torque[2] += factor * (x * fy - y * fx);
  }

  // The forces of a plane, whose normal part only pushes.
  applyPlaneForces(list, body, acceleration, rate) {
    const { vectors, vectorCount, weight } = list;
    for (let r = 0; r < list.count; r++) {
      const v = 3 * vectorCount * r, along = this.dot(acceleration, 3 * r, vectors, v), separation = Math.max(0, this.dot(vectors, v + 6, vectors, v));
      const unit = Math.max(weight[r], 1e-9), ratio = along / unit, softplus = ratio > 20 ? ratio : Math.log1p(Math.exp(ratio));
      const more = unit * softplus / (1 + separation / ForceField.SEPARATION_SPEED) - along, k = 3 * list.row[r];
      const F = [0, 1, 2].map((c) => acceleration[3 * r + c] + more * vectors[v + c]);
      this.apply(rate, F, body.armNow.subarray(k, k + 3), [0, 0, 0], 1);
      for (let c = 0; c < 3; c++) body.local[k + c] += F[c];
    }
  }

  dot(x, i, y, j) { return x[i] * y[j] + x[i + 1] * y[j + 1] + x[i + 2] * y[j + 2]; }

  // Acceleration of a body's displacements, in its frame, into body.internal.
  deform(body) {
    const { n, R, u, du, local, arm, size, massFraction, normal, internal } = body, back = Linear3.transposed(R);
    const fields = new Float64Array(9 * n), virial = new Float64Array(9), gravity = Linear3.times(back, [0, 0, -this.gravity]);
    for (let k = 0, i = 0; k < n; k++, i += 3) {
      Linear3.matvec(back, local, fields, i, 9 * k);
      for (let a = 0; a < 3; a++) {
        fields[9 * k + 3 + a] = u[i + a];
        fields[9 * k + 6 + a] = du[i + a];
        for (let b = 0; b < 3; b++) virial[3 * a + b] += massFraction[k] * fields[9 * k + a] * arm[i + b] / (size * size);
      }
    }
    const [near, far] = body.blur.map((neighbours) => this.means(neighbours, fields, n));
    const spread = virial.map((x, i) => x + virial[3 * (i % 3) + Math.floor(i / 3)]), v = new Float64Array(36 * n), x = new Float64Array(78 * n);
    for (let k = 0, at = 0, i = 0; k < n; k++, i += 3) {
      const w = 36 * k, f = 9 * k;
      for (let a = 0; a < 3; a++) {
        v[w + a] = 20 * u[i + a]; v[w + 3 + a] = 20 * (u[i + a] - near[f + 3 + a]); v[w + 6 + a] = 20 * (u[i + a] - far[f + 3 + a]);
        v[w + 9 + a] = 2 * du[i + a]; v[w + 12 + a] = 2 * (du[i + a] - near[f + 6 + a]); v[w + 15 + a] = 2 * (du[i + a] - far[f + 6 + a]);
        v[w + 18 + a] = near[f + a] / 10; v[w + 21 + a] = far[f + a] / 10;
        v[w + 24 + a] = (spread[3 * a] * arm[i] + spread[3 * a + 1] * arm[i + 1] + spread[3 * a + 2] * arm[i + 2]) / 10;
        v[w + 27 + a] = normal[i + a]; v[w + 30 + a] = arm[i + a] / size; v[w + 33 + a] = gravity[a] / 5;
      }
      at = ForceField.innerProducts(v, w, 12, x, at);
    }
    const out = this.deformation.layers.apply(x, n, body.offsets.deformation), F = ForceField, sigmoid = (y) => 1 / (1 + Math.exp(-y));
    internal.fill(0);
    for (let k = 0; k < n; k++) for (let j = 0; j < 9; j++) {
      const y = out[9 * k + j];
      const weight = j < 3 ? -F.MAX_SPRING_WEIGHT * sigmoid(y - 3) : j < 6 ? -F.MAX_DAMPER_WEIGHT * sigmoid(y - 2) : body.compliance * y;
      for (let a = 0; a < 3; a++) internal[3 * k + a] += 10 * weight * v[36 * k + 3 * j + a];
    }
    body.project(internal);
  }

  means({ first, which, weight }, fields, n) { // of nine values at each point over its neighbourhood
    const out = new Float64Array(9 * n);
    for (let k = 0; k < n; k++) {
      let a0 = 0, a1 = 0, a2 = 0, a3 = 0, a4 = 0, a5 = 0, a6 = 0, a7 = 0, a8 = 0;
      for (let i = first[k]; i < first[k + 1]; i++) {
        const m = weight[i], f = 9 * which[i];
        a0 += m * fields[f]; a1 += m * fields[f + 1]; a2 += m * fields[f + 2]; a3 += m * fields[f + 3]; a4 += m * fields[f + 4];
        a5 += m * fields[f + 5]; a6 += m * fields[f + 6]; a7 += m * fields[f + 7]; a8 += m * fields[f + 8];
      }
      out.set([a0, a1, a2, a3, a4, a5, a6, a7, a8], 9 * k);
    }
    return out;
  }
}
