// The player: the state of a film, its clock and its pictures. `window.player` is the page's.

import { arrowPath, filmArrows } from "player/arrows.js";
import { Camera, controlCamera } from "player/camera.js";
import { unpack } from "player/container.js";
import { buildInterface } from "player/interface.js";
import { startLive } from "player/live.js";
import { SplatRenderer } from "player/splats.js";
import { add, length, subtract } from "player/vectors.js";
import { startWorker } from "player/worker.js";

const QUALITIES = [1, 0.75, 0.5, 0.35]; // resolutions while something moves, for slow machines
const SLOW = 0.05, FAST = 0.015; // drawing times at which the next of these is taken [s]

export async function start() {
  const message = document.getElementById("message");
  try {
    const film = await unpack(document.getElementById("film").textContent);
    window.player = new Player(film, document.getElementById("picture"), document.getElementById("overlay"));
    message.textContent = "";
  } catch (error) {
    message.textContent = error.message;
    throw error;
  }
}

export class Player {
  constructor(film, picture, overlay) {
    Object.assign(this, { film, picture, overlay });
    Object.assign(this, { time: 0, playing: false, speed: 1, loop: true, arrowsShown: Boolean(film.arrows), keys: new Set() });
    Object.assign(this, { hidden: new Set(), highlighted: null, onchange: () => {}, arrows: null });
    Object.assign(this, { quality: 0, changed: true, sent: null, drawing: null, restUntil: 0, waiting: [] });
    const a = film.arrays;
    this.rest = a.keypoints ? a.keypoints.subarray(0, 3 * a.keypoint_object.length) : new Float32Array(0);
    this.positions = this.rest; // of the keypoints, shown
    this.colours = new Map(film.objects.map((o) => [o.id, flatColour(o.id)]));
    this.renderer = new SplatRenderer(picture, film, this.reach());
    this.renderer.mode = film.colours || 0;
    this.updateObjects();
    const view = film.view || film.cameras[0] || overview(a.means);
    this.start = { view, target: film.target || this.middle() };
    this.camera = new Camera(view, this.start.target);
    this.startWorker();
    controlCamera(overlay, this.camera, { changed: () => this.wake(), claim: (event) => this.live?.claim(event) ?? null });
    overlay.addEventListener("dblclick", (event) => this.focusAt(event.offsetX, event.offsetY));
    overlay.addEventListener("pointerdown", () => overlay.focus());
    new ResizeObserver(() => this.resize()).observe(overlay);
    picture.addEventListener("webglcontextlost", () => {
      document.getElementById("message").textContent = "The graphics processor was reset; reload the page.";
    });
    this.live = film.live || film.field ? startLive(this) : null;
    buildInterface(this);
    this.resize();
    this.seek(0);
    this.play(film.frames > 1 && !film.live);
    requestAnimationFrame((now) => this.tick(now));
  }

  startWorker() {
    const a = this.film.arrays;
    this.worker = startWorker();
    this.worker.onmessage = ({ data }) => this.waiting.shift()(data);
    const film = { means: a.means };
    if (a.keypoints) Object.assign(film, {
      rest: this.rest, object: a.keypoint_object, neighbours: a.neighbours, index: a.binding_index,
      weight: normalised(a.binding_weight),
    });
    if (this.film.light) film.spheres = {
      means: this.renderer.occluders.rest, index: a.sphere_index, weight: normalised(a.sphere_weight),
    };
    this.worker.postMessage({ film });
  }

  // Moved and sorted Gaussians for a view, from the worker to the renderer.
  async pose(view) {
    const positions = this.positions === this.sent || !this.rest.length ? null : this.positions;
    this.sent = this.positions;
    const depthRow = [...view.rotation.slice(6, 9), view.translation[2]];
    this.worker.postMessage({ positions, depthRow, nearest: 0.01 });
    this.renderer.setOrder(await new Promise((resolve) => this.waiting.push(resolve)));
  }

  // The bytes RGBA of a picture {viewmat, K, size} at the present time.
  async pixels(view) {
    const fixed = new Camera(view).view(...view.size);
    await this.pose(fixed);
    this.wake();
    return this.renderer.pixels(fixed);
  }

  resize() {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    this.picture.width = Math.max(1, Math.round(ratio * this.overlay.clientWidth));
    this.picture.height = Math.max(1, Math.round(ratio * this.overlay.clientHeight));
    this.wake();
  }

  wake() { this.changed = true; }

  async tick(now) {
    requestAnimationFrame((later) => this.tick(later));
    const seconds = Math.min(0.1, (now - (this.before ?? now)) / 1000);
    this.before = now;
    if (this.playing) this.advance(seconds);
    if (this.camera.advance(seconds, this.keys)) this.wake();
    if (this.busy || !this.drawn() || now < this.restUntil) return;
    this.live?.drawn();
    if (this.changed) this.lastChange = now;
    const sharpen = this.shownQuality > 0 && now - this.lastChange > 250; // at rest, once more at full resolution
    if (!this.changed && !sharpen) return;
    this.changed = false;
    this.busy = true;
    await this.pose(this.view(1));
    this.shownQuality = sharpen ? 0 : this.quality;
    this.renderer.draw(this.view(QUALITIES[this.shownQuality]));
    this.drawArrows();
    const gl = this.renderer.gl;
    this.drawing = { sync: gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0), since: performance.now() };
    gl.flush();
    this.busy = false;
  }

  // Whether the last picture is finished; its time decides about the resolution of the next.
  drawn() {
    if (!this.drawing) return true;
    const gl = this.renderer.gl, { sync, since } = this.drawing;
    if (gl.getSyncParameter(sync, gl.SYNC_STATUS) !== gl.SIGNALED) return false;
    gl.deleteSync(sync);
    this.drawing = null;
    const seconds = (performance.now() - since) / 1000;
    if (this.live?.running && seconds > SLOW) this.restUntil = performance.now() + 1000 * seconds; // leave time to the engine
    if (seconds > SLOW && this.shownQuality === this.quality) this.quality = Math.min(this.quality + 1, QUALITIES.length - 1);
    else if (seconds < FAST) this.quality = Math.max(this.quality - 1, 0);
    return true;
  }

  view(quality) {
    return this.camera.view(Math.max(1, Math.round(quality * this.picture.width)), Math.max(1, Math.round(quality * this.picture.height)));
  }

  drawArrows() {
    const shown = !this.arrowsShown ? [] : this.arrows ?? (this.film.frames ? filmArrows(this.film, this.frame) : []);
    const path = arrowPath(this.camera.view(this.overlay.clientWidth, this.overlay.clientHeight), shown);
    for (const element of this.overlay.querySelectorAll("path")) element.setAttribute("d", path);
  }

  // --- time ---

  get duration() { return this.film.frames > 1 ? (this.film.frames - 1) * this.film.dt : 0; }

  get frame() { // fractional; times within rounding of a frame give its index
    const index = Math.min(this.time / this.film.dt, this.film.frames - 1);
    return Math.abs(index - Math.round(index)) < 1e-4 ? Math.round(index) : index;
  }

  play(playing) {
    this.playing = playing && this.duration > 0;
    if (this.playing && this.time >= this.duration) this.seek(0);
    this.onchange();
  }

  advance(seconds) {
    let time = this.time + this.speed * seconds;
    if (time > this.duration) {
      time = this.loop ? 0 : this.duration;
      this.playing = this.loop;
    }
    this.seek(time);
  }

  seek(time) {
    this.time = Math.max(0, Math.min(this.duration, time));
    if (this.film.frames && !this.live?.running) {
      const { frame } = this, first = Math.floor(frame), here = this.filmPositions(first);
      const next = this.filmPositions(Math.min(first + 1, this.film.frames - 1));
      this.positions = frame === first ? here : here.map((x, i) => x + (frame - first) * (next[i] - x));
    }
    this.wake();
    this.onchange();
  }

  filmPositions(frame) { // of the keypoints in a whole frame
    const p3 = this.rest.length;
    return this.film.arrays.keypoints.subarray(p3 * (frame + 1), p3 * (frame + 2));
  }

  // --- objects, colours, views ---

  updateObjects() {
    const count = 1 + this.film.arrays.object_id.reduce((a, b) => Math.max(a, b), 0);
    const rows = Array.from({ length: count }, (_, id) => {
      const shown = this.hidden.has(id) ? 0 : id === this.highlighted ? 2 : 1;
      return [...(this.colours.get(id) ?? [0.6, 0.6, 0.6]), shown];
    });
    this.renderer.setObjects(rows);
    this.wake();
    this.onchange();
  }

  show(id, shown) {
    if (shown) this.hidden.delete(id); else this.hidden.add(id);
    this.updateObjects();
  }

  // Hide all but one object, and the background; null or a second time: show all.
  isolate(id) {
    const others = [0, ...this.film.objects.map((o) => o.id)].filter((other) => other !== id);
    const already = others.every((other) => this.hidden.has(other)) && !this.hidden.has(id);
    this.hidden = new Set(id === null || already ? [] : others);
    this.updateObjects();
  }

  highlight(id) {
    this.highlighted = id;
    this.updateObjects();
  }

  restyle(changes) { // of the renderer: mode, shadows
    Object.assign(this.renderer, changes);
    this.wake();
  }

  showArrows(shown) {
    this.arrowsShown = shown;
    this.wake();
  }

  showCamera(index) { // -1: the view of the start
    const view = index < 0 ? this.start.view : this.film.cameras[index];
    this.camera.set(view, this.start.target);
    this.wake();
  }

  // The object and the point shown at a position on the page [CSS px], or null.
  pick(x, y) {
    const ratio = this.picture.width / this.overlay.clientWidth, view = this.view(1);
    const found = this.renderer.pick(view, x * ratio, y * ratio);
    return found && {
      object: this.film.arrays.object_id[found.gaussian], depth: found.depth,
      point: Camera.point(view, x * ratio, y * ratio, found.depth),
    };
  }

  focusAt(x, y) {
    const found = this.pick(x, y);
    if (found) this.camera.focus(found.point);
    this.wake();
  }

  // Largest displacement of a keypoint in the film, 1 where nothing moves.
  reach() {
    const all = this.film.arrays.keypoints, p3 = this.rest.length;
    let largest = 0;
    for (let i = 0; all && i < all.length; i += 3)
      largest = Math.max(largest, Math.hypot(all[i] - all[i % p3], all[i + 1] - all[i % p3 + 1], all[i + 2] - all[i % p3 + 2]));
    return largest || 1;
  }

  // The middle of the objects, or of everything.
  middle() {
    const a = this.film.arrays, ids = a.object_id, some = ids.some((id) => id > 0);
    const values = [0, 1, 2].map((axis) => Float32Array.from(ids.keys()).filter((i) => !some || ids[i] > 0).map((i) => a.means[3 * i + axis]).sort());
    return values.map((x) => x[x.length >> 1] ?? 0);
  }
}

// Colours of the objects as stages/render/draw.py gives them, from hue, saturation and value.
function flatColour(id) {
  const hue = (id * 0.6180339887498949) % 1, saturation = [0.85, 0.6][Math.floor(id / 5) % 2], value = [0.95, 0.75][Math.floor(id / 3) % 2];
  const channel = (n) => {
    const k = (n + 6 * hue) % 6;
    return value * (1 - saturation * Math.max(0, Math.min(k, 4 - k, 1)));
  };
  return [channel(5), channel(3), channel(1)];
}

function normalised(weights) { // of eight keypoints each; rounded as the renderer rounds them
  const out = Float32Array.from(weights, (w) => Math.round(255 * w));
  for (let i = 0; i < out.length; i += 8) {
    const sum = out.subarray(i, i + 8).reduce((a, b) => a + b, 0);
    for (let j = i; j < i + 8; j++) out[j] /= sum;
  }
  return out;
}

// A view of everything from the front, for a scene without cameras.
function overview(means) {
  const axis = (i) => Float32Array.from({ length: means.length / 3 }, (_, n) => means[3 * n + i]).sort();
  const sorted = [axis(0), axis(1), axis(2)], at = (f) => sorted.map((x) => x[Math.floor(f * (x.length - 1))] ?? 0);
  const middle = at(0.5), size = length(subtract(at(0.95), at(0.05))) || 1;
  const eye = add(middle, [0, -0.9, 0.45], 1.3 * size), camera = { rows: null };
  Camera.prototype.lookAt.call(Object.assign(camera, { eye }), middle);
  const t = camera.rows.map((row) => -(row[0] * eye[0] + row[1] * eye[1] + row[2] * eye[2]));
  return { viewmat: camera.rows.map((row, i) => [...row, t[i]]), K: [[768, 0, 320], [0, 768, 240], [0, 0, 1]], size: [640, 480] };
}
