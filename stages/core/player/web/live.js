// A live session: frames from the engine, and what the user does to the objects. The other side is stages/simulate/live,
// or a worker in this page, which goes on from the film when the user first acts.

import { Camera } from "player/camera.js";
import { startLocalEngine } from "player/local.js";

const LIFT = 0.15; // of a press of U [distances of the camera]
const RETRY = 1000; // [ms]
const SHOW_TIME = 150; // between changes of the text [ms]
const INVITATION = "Drag an object: from then on its motion is computed here.";

export function startLive(player) { return new Live(player); }

class Live {
  constructor(player) {
    const { film } = player, local = !film.live;
    Object.assign(this, { player, local, running: !local, control: local, state: null, pointer: null, strength: 1 });
    this.settings = film.live ?? {
      dt: film.dt, gravity: film.field.real_gravity, materials: Object.keys(film.field.materials),
      material: Object.fromEntries(film.objects.map((o, i) => [o.id, film.field.names[i]])),
    };
    player.overlay.addEventListener("pointermove", (event) => { this.pointer = [event.offsetX, event.offsetY]; });
    this.build();
    if (local) this.post = startLocalEngine(player, (state, positions) => this.running && this.take(state, positions), download);
    else this.connect();
  }

  // Go on from the present frame of the film, computed here.
  begin() {
    const { player } = this;
    player.play(false);
    this.running = true;
    this.rate.textContent = "computing the motion up to here …";
    this.post({ do: "take_over", frame: Math.round(player.frame) });
    document.getElementById("arrows").checked = true;
    player.showArrows(true);
    player.onchange();
  }

  // Back to the film.
  end() {
    this.running = false;
    this.post({ do: "stop" });
    this.player.arrows = this.state = null;
    this.rate.textContent = INVITATION;
    this.player.seek(this.player.time);
  }

  connect() {
    this.socket = new WebSocket(location.href.replace(/^http/, "ws").replace(/[^/]*$/, "live"));
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.send({ do: "drawn" });
    this.socket.onmessage = ({ data }) => typeof data === "string" ? this.setRole(JSON.parse(data)) : this.unpack(data);
    this.socket.onclose = () => {
      this.control = false;
      this.rate.textContent = "The simulation has ended, or cannot be reached.";
      setTimeout(() => this.connect(), RETRY);
    };
  }

  send(message) {
    if (this.local) this.post(message);
    else if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  act(message) { // of the one page that controls
    if (!this.control) return;
    if (!this.running) this.begin();
    this.send(message);
  }

  setRole({ control }) {
    this.control = control;
    this.role.textContent = control ? "" : "Another page controls this simulation; this one watches.";
  }

  unpack(data) {
    const length = new DataView(data).getUint32(0, true);
    this.take(JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length))), new Float32Array(data, 4 + length));
  }

  take(state, positions) {
    const { player } = this, before = player.positions, { arrows } = state, arrowsBefore = player.arrows ?? [];
    this.state = state;
    player.arrows = arrows;
    if (positions.some((x, i) => x !== before[i])) player.positions = positions;
    if (player.positions !== before || arrows.length || arrowsBefore.length) player.wake();
    this.unanswered = true;
    this.show();
  }

  drawn() { // the player has drawn the last frame
    if (this.unanswered) this.send({ do: "drawn" });
    this.unanswered = false;
  }

  show() {
    if (performance.now() - (this.shown ?? -Infinity) < SHOW_TIME) return;
    this.shown = performance.now();
    const { time, rate, paused, speed, note, gravity } = this.state, { dt } = this.settings;
    const real = rate * dt, slow = !paused && rate > 0 && real < 0.9 * speed;
    this.rate.textContent = `${time.toFixed(2)} s` + (paused ? ", paused" : `, ${rate.toFixed(0)} steps/s, ${real.toFixed(2)}× real time`)
      + (slow ? ": this machine is slower than the motion" : "") + (note ? `\n${note}` : "");
    this.pauseButton.textContent = paused ? "▶ go on" : "❚❚ pause";
    if (document.activeElement !== this.gravity) this.gravity.value = gravity;
    this.gravityText.textContent = gravity.toFixed(2);
    for (const row of document.getElementById("objects").children) {
      const id = Number(row.dataset.id), marks = [this.state.pinned.includes(id) ? "📌" : "", this.state.lifted.includes(id) ? "✋" : ""];
      row.querySelector(".name").dataset.marks = marks.join("");
    }
  }

  // A press on an object drags it; anywhere else it is the camera's.
  claim(event) {
    if (!this.control || event.button !== 0 || event.shiftKey) return null;
    const found = this.player.pick(event.offsetX, event.offsetY);
    if (!found || !found.object) return null;
    const target = (e) => this.at(e.offsetX, e.offsetY, found.depth);
    this.act({ do: "grab", object: found.object, point: found.point, target: target(event) });
    return {
      move: (e) => this.act({ do: "move", target: target(e) }),
      end: () => this.act({ do: "release" }),
    };
  }

  at(x, y, depth) {
    const ratio = this.player.picture.width / this.player.overlay.clientWidth;
    return Camera.point(this.player.view(1), ratio * x, ratio * y, depth);
  }

  // Call `action` with what is under the cursor, if it is an object.
  underCursor(action) {
    const found = this.pointer && this.player.pick(...this.pointer);
    if (found && found.object) action(found);
  }

  push() {
    const { eye } = this.player.camera;
    this.underCursor(({ object, point }) => this.act({
      do: "push", object, point, direction: point.map((x, i) => x - eye[i]), strength: this.strength,
    }));
  }

  lift(sign = 1) {
    this.underCursor(({ object }) => this.act({ do: "lift", object, height: sign * LIFT * this.player.camera.distance }));
  }

  pin() {
    this.underCursor(({ object }) => this.act({ do: "pin", object, value: !this.state?.pinned.includes(object) }));
  }

  drop() { for (const object of this.state?.lifted ?? []) this.act({ do: "drop", object }); }

  save() { if (this.running) this.act({ do: "save" }); }

  pause() {
    if (this.running) this.act({ do: "pause", value: !this.state?.paused });
    else this.player.play(!this.player.playing);
  }

  keys() {
    return [
      ...(this.local ? [] : [[" ", "space", "pause or go on", () => this.pause()]]), // the film's pauses both
      [".", ".", "one step, while paused", () => this.act({ do: "step" })],
      ["p", "P", "push the object under the cursor away", () => this.push()],
      ["u", "U", "lift it and hold it", () => this.lift()],
      ["j", "J", "hold it lower", () => this.lift(-1)],
      ["g", "G", "let go of what is held", () => this.drop()],
      ["n", "N", "pin or unpin it", () => this.pin()],
      ["r", "R", `back to the start${this.local ? "" : ", with a new recording"}`, () => this.act({ do: "reset" })],
      ...(this.local ? [["b", "B", "back to the film", () => this.end()], ["x", "X", "save what was done, for ngff simulate --forces", () => this.save()]]
        : [["b", "B", "save the recording", () => this.save()]]),
    ];
  }

  gestures() { return [["drag an object", "pull it; let go while it moves to throw it"]]; }

  build() {
    const { settings } = this, panel = document.getElementById("live-controls");
    const make = (tag, properties = {}, ...children) => {
      const node = Object.assign(document.createElement(tag), properties);
      node.append(...children);
      return node;
    };
    const button = (text, title, onclick) => make("button", { textContent: text, title, onclick });
    const slider = (min, max, step, value, oninput) => make("input", { type: "range", min, max, step, value, oninput });
    this.pauseButton = button("❚❚ pause", "space", () => this.pause());
    this.gravityText = make("output", {}, settings.gravity.toFixed(2));
    this.gravity = slider(-5, 20, 0.01, settings.gravity, () => this.act({ do: "gravity", value: Number(this.gravity.value) }));
    const friction = slider(0, 1.5, 0.05, 0.5, () => this.act({ do: "friction", value: Number(friction.value) }));
    const strength = slider(0.2, 4, 0.1, 1, () => { this.strength = Number(strength.value); });
    const speed = make("select", { onchange: () => this.act({ do: "speed", value: Number(speed.value) }) },
      ...[1, 0.5, 0.25, 0.1].map((s) => new Option(`${s}×`, s)));
    this.rate = make("p", { id: "rate", style: "white-space: pre-line" }, this.local ? INVITATION : "connecting …");
    const last = [button("save", this.local ? "X" : "B", () => this.save()), ...(this.local ? [button("film", "B", () => this.end())] : [])];
    this.role = make("p");
    panel.append(
      make("div", { className: "buttons" }, this.pauseButton, button("step", ".", () => this.act({ do: "step" })),
        button("start again", "R", () => this.act({ do: "reset" })), ...last, speed),
      make("label", {}, "Gravity", this.gravity, this.gravityText), make("label", {}, "Friction", friction),
      make("label", {}, "Push", strength), this.rate, this.role,
    );
    this.materialSelect = (id) => make("select", {
      title: "material", onchange: ({ target }) => this.act({ do: "material", object: id, name: target.value }),
    }, ...[...new Set([settings.material[id], ...settings.materials])].map((name) => new Option(name, name)));
  }
}

// Save what was done in this page, as `ngff simulate --forces` reads it.
function download(recording) {
  const href = URL.createObjectURL(new Blob([JSON.stringify(recording)], { type: "application/json" }));
  Object.assign(document.createElement("a"), { href, download: `${document.title}-forces.json` }).click();
  setTimeout(() => URL.revokeObjectURL(href), 1000);
}
