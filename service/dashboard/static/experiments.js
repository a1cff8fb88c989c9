// All experiments: start one and hold its lease; its progress, the limits, and its result.

import { h, fill, seconds, text } from "./dom.js";
import { number } from "./numbers.js";

// The parameters of an experiment as text; `unit` is that of its amplitude.
const WORDS = {
  amplitude_deg: (x) => `amplitude ${number(x)}\u00a0deg`, amplitude: (x, unit) => `amplitude ${number(x)}\u00a0${unit}`,
  start_frequency: (x) => `from ${number(x)}\u00a0Hz`, stop_frequency: (x) => `to ${number(x)}\u00a0Hz`, frequency: (x) => `${number(x)}\u00a0Hz`,
  frequencies: (x) => `${x.map((each) => number(each)).join(", ")}\u00a0Hz`, width: (x) => `${number(x)}\u00a0s wide`, lines: (x) => `${number(x)} lines`,
  spectrum: (x) => `${x.length} lines`, controller: (x) => `${x} controller`,
  load: (x) => `a load of ${number(x.torque)}\u00a0N m after ${number(x.after)}\u00a0s`,
  tilt: (x) => `tilted over by hand after ${number(x.after)}\u00a0s, in ${number(x.duration)}\u00a0s`,
  spin: (x) => `flywheels ${x.up ? "brought to their speed" : "switched off"} after ${number(x.after)}\u00a0s`,
};

const UNITS = { trim_rate: "m/s" }; // of an amplitude, where it is not that of the vehicle's setpoint

const isOff = (each) => each.at === "rest" && each.excitation === "none";

// What a person is asked to do to the vehicle now, as a sentence; nothing while nothing is asked.
export const asked = (state) => (state.load ?? state.tilt ?? state.spin)?.announcement;

// Whether the vehicle leaves its support.
export const getsUp = (each) => each.at !== "support" && !isOff(each);

// An experiment in words; `unit` is that of the vehicle's setpoint.
export function describe(each, unit) {
  const silent = each.excitation === "silence";
  const what = silent ? `no setpoints and no heartbeat for ${number(each.width)}\u00a0s` : isOff(each) ? "drives off"
    : each.excitation === "none" ? "no excitation" : `${each.excitation.replaceAll("_", " ")}${each.at === "support" ? " of the drives" : ""}`;
  const details = Object.entries(WORDS).filter(([key]) => each[key] !== undefined && !(silent && key === "width"))
    .map(([key, words]) => words(each[key], UNITS[each.at] ?? unit));
  return [`${number(each.duration)}\u00a0s`, what, ...details].join(", ");
}

// What an experiment does not do: nobody should wait for the vehicle to get up.
export const stays = (each) => (getsUp(each) ? null : h("span", { class: "badge", "data-kind": "active" }, "stays on its support"));

// Why no experiment can be started now; empty if one can.
export function obstacle(state) {
  if (!state) return "The vehicle has not been heard yet";
  if (!state.commands) return "Commands over MQTT are off: set commands = true under [mqtt] in the vehicle file";
  return state.mode === "running" ? "An experiment is running" : state.interlocks.join(" ");
}

export class Experiments {
  constructor(place, app) {
    this.app = app;
    this.buttons = [];
    this.bar = h("progress", { id: "progress", max: 1, value: 0, "aria-label": "Progress" });
    this.what = h("p", { id: "progress-text" }, "No experiment is running.");
    this.outcome = h("p", { id: "outcome", role: "status" });
    this.reset = h("button", { id: "reset", hidden: true, onclick: () => this.acknowledge() }, "Reset the fault: its cause has been removed");
    const cards = Object.entries(app.config.experiments).map(([name, each]) => {
      const button = h("button", { class: "primary", "data-experiment": name, onclick: () => this.start(name) }, "Start");
      this.buttons.push(button);
      return h("li", { class: "card" }, h("h3", {}, name, " ", stays(each)), h("p", {}, each.title),
        h("p", { class: "quiet" }, describe(each, app.config.amplitude_unit)), button);
    });
    const limits = app.config.limits.map(({ name, value, unit }) => h("div", {}, h("dt", {}, name), h("dd", { "data-limit": name }, `${number(value)} ${unit}`)));
    fill(place,
      h("section", { class: "card wide" }, h("h2", {}, "Running"), this.what, this.bar, this.outcome, this.reset,
        h("p", { class: "quiet" }, "The page that starts an experiment holds its lease: if the page is closed, hidden or disconnected for ",
          `${1000 * app.config.lease} ms, the experiment ends in order and the vehicle is lowered. Escape stops it. An experiment is accepted if it runs to its `,
          "end within the limits below; otherwise the reason is shown here.")),
      h("h2", {}, "Experiments"), h("ul", { class: "cards plain" }, cards),
      h("section", { class: "card wide" }, h("h2", {}, "Limits of this vehicle"), h("dl", { class: "columns" }, limits)));
  }

  async start(name) {
    text(this.outcome, "");
    const first = await this.app.link.experiment(name, (reply) => this.over(name, reply));
    if (!first.ok) this.over(name, first);
    this.state(this.app.state);
  }

  over(name, reply) {
    const words = this.app.named(reply.text);
    this.outcome.dataset.ok = !reply.ok ? "false" : words ? "early" : "true";
    const came = !reply.ok ? `${reply.code}: ${words}` : words ? `ended early: ${words}` : "accepted, completed within the limits";
    text(this.outcome, `${name}: ${came}`.replace(/[^.]$/, "$&.")
      + (typeof reply.recording === "string" ? ` Recording: ${reply.recording.split("/").pop()}` : ""));
  }

  async acknowledge() {
    const reply = await this.app.link.command("reset");
    text(this.outcome, reply.ok ? "The drives are set up again." : `${reply.code}: ${reply.text}`);
  }

  state(state) {
    if (!state) return;
    this.reset.hidden = state.mode !== "fault" || !state.commands;
    const running = state.mode === "running";
    const why = obstacle(state);
    for (const button of this.buttons) {
      button.disabled = Boolean(why);
      button.title = why;
    }
    if (running) text(this.what, `${state.experiment}: ${state.phase}, held by ${this.app.named(state.held_by || "nobody")}`);
    else {
      text(this.what, !state.commands ? `${why}.` : state.interlocks.length ? `Not ready: ${state.interlocks.join(" ")}` : "No experiment is running.");
      this.bar.value = 0;
    }
  }

  progress(message) {
    if (this.app.state?.mode === "running") {
      this.bar.value = Math.min(1, Math.max(0, message.fraction));
      text(this.what, `${message.task}: ${this.app.state.phase}, ${Math.round(100 * this.bar.value)} %, ${seconds(message.remaining)} left, held by ${this.app.named(this.app.state.held_by || "nobody")}`);
    }
  }
}
