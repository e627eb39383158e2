// The spheres of the objects as a texture for the shadows; stages/core/physics/occluders.py and raster/shadows.py explain.

const HEAD = 2; // texels of an object: middle and radius of its spheres | object, first sphere, spheres, weight

export class Occluders {
  constructor(film) {
    const a = film.arrays, rest = (this.rest = new Float32Array(3 * a.sphere_object.length));
    for (let i = 0; i < a.sphere_object.length; i++) rest.set(a.spheres.subarray(4 * i, 4 * i + 3), 3 * i);
    this.radii = a.sphere_object.map((_, i) => a.spheres[4 * i + 3]);
    this.fade = !film.light.in_colours;
    this.objects = [];
    a.sphere_object.forEach((id, i) => {
      const last = this.objects.at(-1);
      if (last && last.id === id) last.count++;
      else this.objects.push({ id, first: i, count: 1, weight: a.sphere_share[i] });
    });
    for (const o of this.objects) Object.assign(o, this.around(o, rest));
    this.centres = rest;
  }

  // Middle of an object's spheres, and the radius around it that holds them.
  around({ first, count }, centres) {
    const middle = [0, 0, 0];
    for (let i = 3 * first; i < 3 * (first + count); i++) middle[i % 3] += centres[i] / count;
    let radius = 0;
    for (let i = first; i < first + count; i++)
      radius = Math.max(radius, this.radii[i] + Math.hypot(...middle.map((m, j) => centres[3 * i + j] - m)));
    return { middle, radius };
  }

  // The share of an object's shadow that is drawn: with `fade`, as far as it moved.
  drawn({ first, count, radius }) {
    if (!this.fade) return 1;
    let moved = 0;
    for (let i = 3 * first; i < 3 * (first + count); i += 3)
      moved += Math.hypot(...[0, 1, 2].map((j) => this.centres[i + j] - this.rest[i + j])) / count;
    return Math.min(1, moved / radius);
  }

  // The values of the texture, and the number of objects: 0 where the photo's own shadows are right.
  texels(hidden) {
    const out = new Float32Array(4 * (HEAD * this.objects.length + this.radii.length));
    const changed = this.centres.some((x, i) => x !== this.rest[i]) || this.objects.some((o) => hidden.has(o.id));
    this.objects.forEach((o, row) => {
      const { middle, radius } = this.around(o, this.centres);
      const weight = hidden.has(o.id) ? 0 : o.weight * this.drawn(o);
      out.set([...middle, radius, o.id, HEAD * this.objects.length + o.first, o.count, weight], 4 * HEAD * row);
    });
    this.radii.forEach((r, i) => {
      out.set([...this.centres.subarray(3 * i, 3 * i + 3), r], 4 * (HEAD * this.objects.length + i));
    });
    return { values: out, count: changed ? this.objects.length : 0 };
  }
}
