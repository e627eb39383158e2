"use strict";
// One participant's page: films in a fixed order, with the answers kept in localStorage until they are downloaded.
const study = JSON.parse(document.getElementById("study").textContent);
const key = `ngff-questionnaire-${study.study}-${study.participant}`;
const $ = (selector) => document.querySelector(selector);
const video = $("video"), form = $("form");
let state = load();
let since = 0; // time at which the film was shown [ms]; 0: none

/** Answers from an earlier visit, or none. */
function load() {
  const empty = { index: -1, answers: {} };
  try {
    return JSON.parse(localStorage.getItem(key)) ?? empty;
  } catch {
    return empty; // storage is blocked or damaged
  }
}

function save() {
  try {
    localStorage.setItem(key, JSON.stringify(state));
  } catch {
    // storage is blocked: the answers are lost when the page is closed
  }
}

const film = () => study.films[state.index];
const answer = () => (state.answers[film()] ??= { seen: false, seconds: 0 });
const complete = (a) => a !== undefined && (a.unplayable || study.scales.every((scale) => a[scale] !== undefined));
const answered = () => study.films.filter((id) => complete(state.answers[id])).length;

function show(id) {
  for (const section of document.querySelectorAll("section")) section.hidden = section.id !== id;
}

/** Show a film, the introduction before the first one, or the end after the last one. */
function go(index) {
  if (film() && since) answer().seconds += (performance.now() - since) / 1000;
  since = 0;
  video.pause();
  state.index = Math.max(-1, Math.min(index, study.films.length));
  save();
  if (state.index < 0) return show("introduction");
  if (!film()) {
    $("#summary").textContent = `You have judged ${answered()} of ${study.films.length} films.`;
    return show("end");
  }
  show("trial");
  document.activeElement?.blur(); // so that keys act on the page instead of the last clicked button
  since = performance.now();
  answer().unplayable = false;
  video.src = `films/${film()}.mp4`;
  play();
  update();
}

function play() {
  video.currentTime = 0;
  video.play().catch(() => {}); // if autoplay is blocked, the user can click "Play again"
}

/** Update the page to show the current answers. */
function update() {
  const a = answer();
  for (const scale of study.scales) {
    for (const input of form.elements[scale]) input.checked = Number(input.value) === a[scale];
    form.elements[scale][0].closest("fieldset").disabled = !a.seen;
  }
  $("progress").value = answered();
  $("#count").textContent = `film ${state.index + 1} of ${study.films.length}`;
  $("#next").disabled = !complete(a);
  $("#message").textContent = a.unplayable ? "This film cannot be played here; please go on to the next one."
    : a.seen ? "" : "Please watch the film to its end.";
}

function choose(scale, value) {
  if (!answer().seen) return;
  if (value === undefined) delete answer()[scale];
  else answer()[scale] = value;
  save();
  update();
}

function download() {
  const answers = study.films.filter((id) => complete(state.answers[id])).map((id) => {
    const { seconds, unplayable, ...rest } = state.answers[id];
    if (unplayable) return { film: id, unplayable: true };
    return { film: id, ...Object.fromEntries(study.scales.map((s) => [s, rest[s]])), seconds: Math.round(10 * seconds) / 10 };
  });
  const data = { study: study.study, participant: study.participant, answers };
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([JSON.stringify(data, null, 1) + "\n"], { type: "application/json" }));
  link.download = `answers-${study.participant}.json`;
  link.click();
}

video.addEventListener("ended", () => {
  answer().seen = true;
  save();
  update();
});
video.addEventListener("error", () => {
  if (!film()) return;
  answer().unplayable = true;
  save();
  update();
});
form.addEventListener("change", (event) => choose(event.target.name, Number(event.target.value)));
form.addEventListener("submit", (event) => event.preventDefault());
const next = () => complete(answer()) && go(state.index + 1);
$("#start").addEventListener("click", () => go(0));
$("#back").addEventListener("click", () => go(state.index - 1));
$("#again").addEventListener("click", play);
$("#next").addEventListener("click", next);
$("#review").addEventListener("click", () => go(study.films.length - 1));
$("#download").addEventListener("click", download);

addEventListener("keydown", (event) => {
  if (!film() || event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  const onButton = event.target instanceof HTMLButtonElement;
  const open = study.scales.find((scale) => answer()[scale] === undefined);
  const last = study.scales.findLast((scale) => answer()[scale] !== undefined);
  if (Number(event.key) >= 1 && Number(event.key) <= study.points && open) choose(open, Number(event.key));
  else if (event.key === "Backspace" && last) choose(last, undefined);
  else if (event.key === " " && !onButton) play();
  else if (event.key === "Enter" && !onButton) next();
  else if (event.key === "PageUp") go(state.index - 1);
  else return;
  event.preventDefault();
});

if (state.index >= 0) go(state.index);
