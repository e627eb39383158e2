// The engine in this page: a worker that takes the messages of a live session and answers with frames.

import { Body } from "player/body.js";
import { Contacts } from "player/contacts.js";
import { FieldEngine, Sleep } from "player/engine.js";
import { ForceField } from "player/force_field.js";
import { Layers, Linear3 } from "player/layers.js";
import { Clock, Session } from "player/session.js";
import { largestEigenvector, nearestRotation } from "player/skinning.js";
import { workerOf } from "player/worker.js";

const SOURCE = [Linear3, Layers, Body, Contacts, ForceField, nearestRotation, largestEigenvector, Sleep, FieldEngine, Session, Clock, serveEngine];

export function startLocalEngine({ film, rest }, take) {
  const worker = workerOf(SOURCE, "serveEngine");
  worker.onmessage = ({ data }) => take(data.state, data.positions);
  worker.postMessage({ film: engineInput(film, rest) });
  return (message) => worker.postMessage(message);
}

// What an engine needs of a film.
export function engineInput({ field, forces, objects, dt, arrays }, rest) {
  const kept = Object.entries(arrays).filter(([name]) => /^(field|weights)_/.test(name));
  return { field, forces, objects, dt, rest: rest.slice(), object: arrays.keypoint_object, arrays: Object.fromEntries(kept) };
}

function serveEngine() {
  let clock;
  self.onmessage = ({ data }) => {
    if (data.film) clock = new Clock(new FieldEngine(data.film), (frame) => self.postMessage(frame));
    else clock.take(data);
  };
}
