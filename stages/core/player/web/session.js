// What a user does to the objects of an engine in this page, and its clock: stages/simulate/live/{session,loop}.py. Part of
// the worker's source.

export class Session {
  static SPRING = 7; // angular frequency of the spring from a grabbed point to the cursor [1/s]
  static DAMPING = 0.8; // of critical
  static MAX_ACCELERATION = 60; // by a spring [m/s^2]
  static MARGIN = 0.01; // of a frame at both ends in which its forces do not act
  static MAX_PUSHES = 3; // in one frame
  static ARROW_TIME = 0.4; // for which the arrow of a push is shown [s]
  static PUSH_ARROW = 0.25; // length of the arrow of a push of 1 scene unit per second [scene units]

  constructor(engine) {
    Object.assign(this, { engine, unit: engine.field.unit, dt: engine.dt, ids: engine.ids });
    this.begin();
  }

  begin() { // after the engine was set to a frame
    Object.assign(this, { changes: [], pushes: [], pushArrows: [], arrows: [], record: [], dragged: null, lifted: new Map(), now: null });
    this.observe();
  }

  observe() {
    const positions = this.engine.positions();
    this.before = this.now;
    this.now = { positions, centres: this.engine.centres(positions) };
  }

  handle(message) {
    const { object: id } = message, { engine, lifted } = this;
    if (id !== undefined && !this.ids.includes(id)) return;
    const act = {
      grab: () => { this.dragged = { id, k: this.nearest(id, message.point), target: message.target }; },
      move: () => { if (this.dragged) this.dragged.target = message.target; },
      release: () => { this.dragged = null; },
      push: () => { if (this.pushes.length < Session.MAX_PUSHES) this.pushes.push(message); },
      lift: () => {
        const [x, y, z] = lifted.get(id) ?? this.now.centres[this.ids.indexOf(id)];
        lifted.set(id, [x, y, z + message.height]);
      },
      drop: () => lifted.delete(id),
      pin: () => this.change("pinned", message.value, id),
      gravity: () => this.change("gravity", message.value),
      friction: () => this.change("friction", message.value),
      material: () => { if (message.name in engine.field.materials) this.change("material", message.name, id); },
    }[message.do];
    if (act) act();
  }

  change(what, value, object_id = null) { // with the next frame, in place of the same change
    this.changes = this.changes.filter((c) => c.what !== what || c.object_id !== object_id);
    this.changes.push({ what, value, object_id });
  }

  // What was done since `begin`, as `ngff simulate --forces` reads it (stages/core/physics/recording.py).
  get recording() {
    const { field, frame, forces } = this.engine;
    return { options: field.options, frames: frame + 1, prompts: [...forces, ...this.record] };
  }

  // One frame of the engine.
  advance() {
    const forces = this.forces(), { changes, engine } = this;
    for (const { object_id, force, start, end, keypoint: k } of forces) {
      const at = k === undefined ? null : Array.from(engine.rest.subarray(3 * k, 3 * k + 3));
      this.record.push({ kind: "force", object_id, force, start, end, at });
    }
    this.record.push(...changes.map((change) => ({ kind: "change", ...change, start: engine.frame * this.dt })));
    this.changes = [];
    this.pushes = [];
    this.engine.advance(forces, changes);
    this.observe();
    return this.now.positions.every(Number.isFinite);
  }

  // The forces of the next frame [N], and the arrows that show them.
  forces() {
    const { engine, dt, now, before, dragged, lifted, unit } = this, S = Session, start = engine.frame * dt, forces = [];
    // as the session's changes take effect in the next frame, before its forces
    const pinned = new Set(engine.pinned);
    for (const c of this.changes) if (c.what === "pinned") pinned[c.value ? "add" : "delete"](c.object_id);
    const gravity = this.changes.find((c) => c.what === "gravity")?.value ?? engine.gravity, weight = [0, 0, gravity];
    const act = (id, acceleration, keypoint) => {
      const newtons = acceleration.map((x) => engine.masses[this.ids.indexOf(id)] * x / (1 - 2 * S.MARGIN));
      forces.push({ object_id: id, force: newtons, start: start + S.MARGIN * dt, end: start + dt - S.MARGIN * dt, ...(keypoint === undefined ? {} : { keypoint }) });
    };
    this.arrows = [];
    if (dragged && !pinned.has(dragged.id)) {
      const here = this.keypoint(now, dragged.k);
      act(dragged.id, this.spring(here, before && this.keypoint(before, dragged.k), dragged.target), dragged.k);
      act(dragged.id, weight);
      this.arrows.push([here, dragged.target]);
    }
    for (const [id, target] of lifted) {
      if (pinned.has(id) || dragged?.id === id) continue;
      const row = this.ids.indexOf(id);
      act(id, this.spring(now.centres[row], before && before.centres[row], target).map((x, a) => x + weight[a]));
    }
    for (const { object: id, point, direction, strength } of this.pushes) {
      const size = Math.hypot(...direction), unitVector = direction.map((x) => x / size), k = this.nearest(id, point);
      act(id, unitVector.map((x) => x * strength * unit / dt), k);
      const tip = this.keypoint(now, k);
      this.pushArrows.push([start, tip.map((x, a) => x - S.PUSH_ARROW * strength * unitVector[a]), tip]);
    }
    this.pushArrows = this.pushArrows.filter(([since]) => start - since < S.ARROW_TIME);
    this.arrows.push(...this.pushArrows.map(([, tail, tip]) => [tail, tip]));
    return forces;
  }

  // Acceleration of a damped spring [m/s^2] to the target, or to the point within the walls that is nearest to it.
  spring(here, before, target) {
    const { SPRING, DAMPING, MAX_ACCELERATION } = Session, { pull_range: range } = this.engine.field;
    const goal = range ? target.map((x, a) => Math.min(Math.max(x, range[0][a]), range[1][a])) : target;
    const pull = here.map((x, a) => this.unit * (SPRING ** 2 * (goal[a] - x) - 2 * DAMPING * SPRING * (before ? (x - before[a]) / this.dt : 0)));
    const most = Math.min(1, MAX_ACCELERATION / Math.max(Math.hypot(...pull), 1e-9));
    return pull.map((x) => most * x);
  }

  keypoint({ positions }, k) { return Array.from(positions.subarray(3 * k, 3 * k + 3)); }

  nearest(id, point) {
    const { positions } = this.now, distance = (k) => [0, 1, 2].reduce((sum, a) => sum + (positions[3 * k + a] - point[a]) ** 2, 0);
    return this.engine.rows[this.ids.indexOf(id)].reduce((best, k) => distance(k) < distance(best) ? k : best);
  }
}

// The loop of the worker: takes messages, advances when it is time, and sends a frame when the last one was drawn.
export class Clock {
  static MAX_LAG = 0.25; // behind real time, which then passes more slowly [s]
  static RATE_TIME = 1; // over which the rate is measured [s]
  static IDLE = 100; // between turns while paused [ms]

  // While the film, of `frames`, is shown, its motion is computed ahead for the moment when the user first acts.
  constructor(engine, frames, send) {
    Object.assign(this, { engine, frames, send, session: new Session(engine), ahead: true, paused: true, speed: 1, note: "", turns: [], ready: true, news: false });
  }

  take(message) {
    const now = performance.now() / 1000, act = {
      take_over: () => this.begin(() => this.engine.goTo(message.frame)),
      reset: () => this.begin(() => this.engine.restart()),
      stop: () => {
        this.paused = this.ahead = true;
        this.engine.goTo(this.engine.kept.at(-1)?.frame ?? 0);
      },
      save: () => this.send({ recording: this.session.recording }),
      pause: () => { this.paused = message.value; this.due = now; this.turns = []; },
      step: () => { if (this.paused) this.advance(now); },
      speed: () => { this.speed = message.value; this.due = now; this.turns = []; },
    }[message.do];
    if (message.do === "drawn") this.ready = true; else this.news = true;
    if (act) act(); else this.session.handle(message);
    this.turn();
  }

  begin(set) {
    set();
    this.session.begin();
    Object.assign(this, { ahead: false, paused: false, note: "", due: performance.now() / 1000, turns: [], ready: true });
  }

  turn() {
    clearTimeout(this.timer);
    const now = performance.now() / 1000;
    if (!this.paused && now >= this.due) {
      this.due = Math.max(this.due + this.engine.dt / this.speed, now - Clock.MAX_LAG);
      this.advance(now);
    }
    this.show();
    let wait = this.paused ? Clock.IDLE : Math.max(0, 1000 * (this.due - performance.now() / 1000));
    if (this.ahead && this.engine.frame < this.frames - 1) {
      this.engine.prepare();
      wait = 1000 * (performance.now() / 1000 - now); // half of the time is left to the pictures
    }
    this.timer = setTimeout(() => this.turn(), wait);
  }

  advance(now) {
    if (!this.session.advance()) {
      this.note = "The motion ceased to be finite. Start again with R.";
      this.paused = true;
      return;
    }
    this.turns.push(now);
    while (now - this.turns[0] > Clock.RATE_TIME) this.turns.shift();
    this.news = true;
  }

  show() {
    if (!this.ready || !this.news) return;
    this.ready = this.news = false;
    const { session, engine, turns } = this, span = turns.length > 1 ? turns.at(-1) - turns[0] : 0;
    const state = {
      time: engine.frame * engine.dt, frames: engine.frame + 1, paused: this.paused, speed: this.speed,
      rate: span > 0 ? (turns.length - 1) / span : 0, arrows: session.arrows, pinned: [...engine.pinned], lifted: [...session.lifted.keys()],
      gravity: engine.gravity, note: this.note,
    };
    this.send({ state, positions: session.now.positions });
  }
}
