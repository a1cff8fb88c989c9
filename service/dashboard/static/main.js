// The page: views, the connection, and the stop button. Each view gets messages and draws itself while it is on the screen.

import { $, fill, text } from "./dom.js";
import { print } from "./charts.js";
import { Link, newest } from "./link.js";
import { Live } from "./live.js";
import { Commissioning } from "./commissioning.js";
import { asked } from "./experiments.js";
import { Identify } from "./identify.js";
import { Gap } from "./gap.js";
import { Recordings } from "./recordings.js";
import { ask } from "./jobs.js";
import { login } from "./login.js";

const STALE = 1500; // ms without telemetry after which the displayed data are stale
const LATE = 0.7; // s by which telemetry may be later than at first
const ALIASES = { experiments: "commissioning" }; // earlier names of views, in addresses that people have kept

const config = await ask("api/config");
const views = {};
const app = { config, link: null, state: null, show, notice, stop, named };
let shown = "live";
let heard = 0;
let drawnAt = 0;
const delays = [];

// A text from the vehicle, with "this page" instead of this page's name at the broker.
function named(words) {
  return app.link ? String(words).replaceAll(`mqtt ${app.link.client}`, "this page") : String(words);
}

function notice(words) {
  fill($("notice"), words);
  $("notice").hidden = !words;
}

function show(asked) {
  const name = ALIASES[asked] ?? asked;
  if (!views[name]) return;
  shown = name;
  for (const each of Object.keys(views)) {
    $(`view-${each}`).hidden = each !== name;
    const tab = $(`tab-${each}`);
    tab.setAttribute("aria-selected", String(each === name));
    tab.tabIndex = each === name ? 0 : -1;
  }
  if (location.hash !== `#${name}`) history.replaceState(null, "", `#${name}`);
  views[name].shown?.();
  views[name].dirty = true;
}

async function stop() {
  if ($("stop").disabled) return;
  $("stop").classList.add("pressed");
  const reply = await app.link.command("stop", { now: false });
  $("stop").classList.remove("pressed");
  if (!reply.ok) notice(`Stop: ${reply.text}`);
}

function showLink() {
  const link = app.link;
  const old = heard && performance.now() - heard > STALE;
  const word = link.trouble ? link.trouble : !link.online ? "vehicle offline" : !heard || old ? "stale" : link.late > LATE || performance.now() < link.slowUntil ? "late" : "live";
  const badge = $("link");
  badge.dataset.kind = word === "live" ? "good" : ["stale", "late", "connecting"].includes(word) ? "warn" : "bad";
  const ago = old ? `: last heard ${Math.round((performance.now() - heard) / 1000)} s ago` : "";
  text(badge, word === "stale" ? `stale${ago}` : word === "late" ? `late: data are up to ${link.worst.toFixed(1)} s old` : word);
  document.body.classList.toggle("stale", word !== "live");
  // Enabled in every mode: a stop without a running experiment does no harm.
  $("stop").disabled = !(link.connected && link.online && app.state?.commands);
  $("stop").classList.toggle("idle", app.state?.mode !== "running");
  $("stop").title = app.state && !app.state.commands ? "Commands over MQTT are off: [mqtt] commands in the vehicle file" : "";
}

function showState(state) {
  app.state = state;
  const mode = $("mode");
  text(mode, state.mode);
  mode.dataset.kind = { fault: "bad", running: "active", disarmed: "good" }[state.mode] ?? "warn";
  text($("phase"), state.mode === "running" ? `${state.experiment ?? ""} – ${asked(state) ?? state.phase}` : named(state.reason || ""));
  showLink();
  each("state", state);
}

function each(kind, message) {
  for (const view of Object.values(views)) {
    if (!view[kind]) continue;
    view[kind](message);
    view.dirty = true;
  }
}

function frame() {
  const view = views[shown];
  if (view?.dirty) {
    view.dirty = false;
    view.draw?.();
    if (view === views.live && drawnAt !== heard && app.newest) {
      drawnAt = heard;
      delays.push(Date.now() - app.newest * 1000);
      if (delays.length > 200) delays.shift();
    }
  }
  requestAnimationFrame(frame);
}

function showLatency() {
  if (!delays.length) return;
  const middle = [...delays].sort((a, b) => a - b)[delays.length >> 1];
  $("latency").dataset.ms = String(Math.round(middle));
  text($("latency"), Math.abs(middle) < 60_000 ? `sample to screen: ${Math.round(middle)} ms` : "the clocks of vehicle and browser differ");
}

text($("vehicle"), config.vehicle);
document.title = `${config.vehicle} – upright`;
text($("version"), `upright ${config.version}`);
Object.assign(views, {
  live: new Live($("view-live"), app),
  commissioning: new Commissioning($("view-commissioning"), app),
  identify: new Identify($("view-identify"), app),
  gap: new Gap($("view-gap"), app),
  recordings: new Recordings($("view-recordings"), app),
});

const tabs = [...document.querySelectorAll("[role=tab]")];
tabs.forEach((tab, place) => {
  tab.addEventListener("click", () => show(tab.id.slice(4)));
  tab.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const next = tabs[(place + step + tabs.length) % tabs.length];
    next.focus();
    next.click();
  });
});
$("stop").addEventListener("click", stop);
addEventListener("keydown", (event) => {
  if (event.key === "Escape") stop();
}, true);
addEventListener("beforeprint", () => print(true));
addEventListener("afterprint", () => print(false));
matchMedia("print").addEventListener("change", (event) => print(event.matches));
addEventListener("hashchange", () => show(location.hash.slice(1)));
const first = location.hash.slice(1);
show(views[ALIASES[first] ?? first] ? first : "live");
if (!config.trusted) notice("This page may only look at recordings: for anything else, open it by the address that the dashboard printed.");

app.link = new Link(config, {
  link: (link, refused) => {
    app.link = link;
    showLink();
    if (refused) login(link, notice);
  },
  ignored: (counts) => {
    const total = Object.values(counts).reduce((a, b) => a + b, 0);
    text($("ignored"), `messages ignored: ${total}`);
    $("ignored").dataset.count = String(total);
    $("ignored").title = Object.entries(counts).map(([why, count]) => `${why}: ${count}`).join(", ");
  },
  state: showState,
  telemetry: (message) => {
    heard = performance.now();
    app.newest = newest(message);
    each("telemetry", message);
  },
  parameters: (message) => each("parameters", message),
  methods: (message) => each("methods", message),
  diagnosis: (message) => each("diagnosis", message),
  commissioning: (message) => each("commissioning", message),
  progress: (message) => each("progress", message),
  event: (message) => each("event", message),
});
setInterval(showLink, 250);
setInterval(showLatency, 1000);
requestAnimationFrame(frame);
