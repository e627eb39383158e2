// The engine in this page: a worker that takes the messages of a live session and answers with frames.

import { Body } from "player/body.js";
import { Contacts } from "player/contacts.js";
import { FieldEngine, Sleep } from "player/engine.js";
import { ForceField } from "player/force_field.js";
import { Layers, Linear3 } from "player/layers.js";
import { Clock, Session } from "player/session.js";
import { workerOf } from "player/worker.js";

const SOURCE = [Linear3, Layers, Body, Contacts, ForceField, Sleep, FieldEngine, Session, Clock, serveEngine];

// `take` gets frames, `save` what was recorded.
export function startLocalEngine({ film, rest }, take, save) {
  const worker = workerOf(SOURCE, "serveEngine");
  worker.onmessage = ({ data }) => data.recording ? save(data.recording) : take(data.state, data.positions);
  worker.postMessage({ film: engineInput(film, rest) });
  return (message) => worker.postMessage(message);
}

// What an engine needs of a film.
export function engineInput({ field, forces, objects, dt, frames, arrays }, rest) {
  const kept = Object.entries(arrays).filter(([name]) => /^(field|weights)_/.test(name));
  return { field, forces, objects, dt, frames, rest: rest.slice(), object: arrays.keypoint_object, arrays: Object.fromEntries(kept) };
}

function serveEngine() {
  let clock;
  self.onmessage = ({ data }) => {
    if (!data.film) return clock.take(data);
    clock = new Clock(new FieldEngine(data.film), data.film.frames, (answer) => self.postMessage(answer));
    clock.turn();
  };
}
