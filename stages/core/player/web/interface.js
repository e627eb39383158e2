// The panel, the time bar and the keys of the player.

import { MODES } from "player/splats.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2];
const element = (id) => document.getElementById(id);

// What each key does: [key or code, name in the overlay, description, action].
function keyTable(player) {
  const jump = (seconds) => player.seek(player.time + seconds);
  const cycle = (select, step = 1) => {
    select.selectedIndex = (select.selectedIndex + step + select.options.length) % select.options.length;
    select.dispatchEvent(new Event("change"));
  };
  const films = player.film.live ? [] : [
    [" ", "space", "play or pause", () => player.live ? player.live.pause() : player.play(!player.playing)],
    ["ArrowLeft", "← →", "one frame back or forward", () => jump(-player.film.dt)],
    ["ArrowRight", null, null, () => jump(player.film.dt)],
    ["Home", "Home", "to the start", () => player.seek(0)],
    ["-", "- +", "slower or faster", () => cycle(element("speed"), -1)],
    ["+", null, null, () => cycle(element("speed"))],
    ["l", "L", "repeat or stop at the end", () => element("loop").click()],
  ];
  return [
    ...(player.film.frames > 1 || player.film.live ? films : []),
    ["c", "C", "the view of the next photo", () => cycle(element("view"))],
    ["f", "F", "next colours", () => cycle(element("colours"))],
    ["v", "V", "force arrows", () => element("arrows").click()],
    ...(player.film.light ? [["k", "K", "shadows of what moved", () => element("shadows").click()]] : []),
    ["0", "1 to 9, 0", "show only this object; 0: all", () => player.isolate(null)],
    ...player.film.objects.slice(0, 9).map((o, i) => [`${i + 1}`, null, null, () => player.isolate(o.id)]),
    ["h", "H", "hide the panel", () => element("hide").click()],
    ["t", "T", "light or dark", () => element("theme").click()],
    ["?", "?", "these keys", () => element("help").click()],
    ...(player.live ? player.live.keys() : []),
  ];
}

const POINTER = [
  ["drag", "turn around the scene"], ["right or shift drag, two fingers", "shift"], ["wheel, pinch", "nearer or farther"],
  ["double click", "turn around this point"], ["W A S D, Q E", "walk, up and down"],
];

export function buildInterface(player) {
  const { film } = player, moving = film.frames > 1;
  element("arrows-row").hidden = !moving && !film.live;

  options(element("colours"), MODES, moving || film.live ? MODES.length : 3);
  element("colours").selectedIndex = player.renderer.mode;
  element("colours").onchange = (event) => player.restyle({ mode: event.target.selectedIndex });

  options(element("view"), ["start", ...film.cameras.map((c) => c.name)]);
  element("view").onchange = (event) => player.showCamera(event.target.selectedIndex - 1);

  element("shadows-row").hidden = !film.light;
  element("shadows").onchange = (event) => player.restyle({ shadows: event.target.checked });

  element("arrows").checked = player.arrowsShown;
  element("arrows").onchange = (event) => player.showArrows(event.target.checked);

  element("play").onclick = () => player.play(!player.playing);
  element("time").max = film.frames > 1 ? (film.frames - 1) * film.dt : 0;
  element("time").oninput = (event) => player.seek(Number(event.target.value));
  element("speed").onchange = (event) => { player.speed = SPEEDS[event.target.selectedIndex]; };
  element("loop").onchange = (event) => { player.loop = event.target.checked; };

  element("objects").replaceChildren(...film.objects.map((o) => objectRow(player, o)));
  element("hide").onclick = () => { element("panel").hidden = !element("panel").hidden; };
  element("theme").onclick = toggleTheme;
  element("help").onclick = () => element("keys").open ? element("keys").close() : element("keys").showModal();
  element("keys").querySelector("button").onclick = () => element("keys").close();
  connectKeys(player);
  player.onchange = () => showState(player);
  showState(player);
}

function options(select, names, count = names.length) {
  select.replaceChildren(...names.slice(0, count).map((name) => new Option(name)));
}

function objectRow(player, o) {
  const row = document.createElement("li"), shown = document.createElement("input"), swatch = document.createElement("span");
  const name = document.createElement("span"), material = document.createElement("small"), only = document.createElement("button");
  Object.assign(shown, { type: "checkbox", checked: true, title: "show or hide", onchange: () => player.show(o.id, shown.checked) });
  swatch.className = "swatch";
  swatch.style.background = `rgb(${player.colours.get(o.id).map((x) => Math.round(255 * x))})`;
  Object.assign(name, { className: "name", textContent: `${o.id} ${o.name}`, title: o.name });
  Object.assign(material, { textContent: o.material, title: o.material });
  Object.assign(only, { textContent: "only", title: "show only this object; again: all", onclick: () => player.isolate(o.id) });
  row.dataset.id = o.id;
  row.append(shown, swatch, name, player.live ? player.live.materialSelect(o.id) : material, only);
  row.onmouseenter = () => player.highlight(o.id);
  row.onmouseleave = () => player.highlight(null);
  return row;
}

function toggleTheme() {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
}

// The controls follow the player's state; those of time are the film's.
function showState(player) {
  for (const id of ["play", "time", "clock", "speed", "loop-label"]) element(id).hidden = !(player.film.frames > 1) || Boolean(player.live?.running);
  element("play").textContent = player.playing ? "❚❚" : "▶";
  element("time").value = player.time;
  element("clock").textContent = `${player.time.toFixed(2)} s`;
  for (const row of element("objects").children) row.querySelector("input").checked = !player.hidden.has(Number(row.dataset.id));
}

function connectKeys(player) {
  const table = keyTable(player), list = element("keys").querySelector("dl");
  const named = [...table.filter(([, name]) => name).map(([, name, text]) => [name, text]), ...POINTER, ...(player.live ? player.live.gestures() : [])];
  for (const [name, text] of named) {
    list.append(Object.assign(document.createElement("dt"), { textContent: name }));
    list.append(Object.assign(document.createElement("dd"), { textContent: text }));
  }
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) && event.target.type !== "checkbox" && event.target.type !== "range") return;
    player.keys.add(event.code);
    player.wake();
    const row = table.find(([key]) => key === event.key || key === event.key.toLowerCase());
    if (!row) return;
    event.preventDefault();
    row[3]();
  });
  addEventListener("keyup", (event) => player.keys.delete(event.code));
  addEventListener("blur", () => player.keys.clear());
}
