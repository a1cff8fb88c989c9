// Identify: the live estimates of the parameters, and all methods side by side for a recording.

import { h, fill, number, table, unit } from "./dom.js";
import { Chart } from "./charts.js";
import { disturbances } from "./disturbance.js";
import { picker, run } from "./jobs.js";

const BAND = 1.96; // standard deviations of a 95 % band
const READABLE = 1000; // ms, refresh period of a table
const MOST = 600; // points of a curve; beyond that every second one is dropped

export class Identify {
  constructor(place, app) {
    this.app = app;
    this.tracks = new Map();
    this.drawn = 0;
    this.plots = h("div", { class: "charts" });
    this.now = h("div", { id: "parameters-now" }, h("p", { class: "quiet" }, "No estimates yet: they appear while an experiment runs."));
    this.picker = picker("Recording", "identify-recording");
    this.answer = h("div", { id: "methods" });
    this.busy = h("div");
    this.methods = app.config.methods.map((name) => h("input", { type: "checkbox", name: "method", value: name }));
    const methods = h("details", {}, h("summary", {}, "Which methods"), h("p", { class: "quiet" }, "None selected: all that suit the recording."),
      h("div", { class: "row" }, this.methods.map((box) => h("label", {}, box, ` ${box.value.replaceAll("_", " ")}`))));
    const button = h("button", { class: "primary", id: "identify-run", onclick: () => this.identify() }, "Compare the methods");
    fill(place, h("h2", {}, "While it runs"), this.now, this.plots,
      h("h2", {}, "Methods side by side"), h("p", { class: "row" }, this.picker.element, button), methods, this.busy, this.answer);
  }

  shown() {
    this.picker.load().catch(() => {});
  }

  state(state) {
    if (state.mode === "running" && this.running !== state.since) {
      this.running = state.since;
      for (const track of this.tracks.values()) track.data = [[], [], [], [], []];
    }
  }

  parameters(parameters) {
    const time = this.app.newest ?? 0;
    this.latest = parameters;
    for (const [name, entry] of Object.entries(parameters)) {
      const track = this.track(name, entry);
      const known = typeof entry.value === "number" && typeof entry.std === "number";
      const cad = this.app.config.parameters[name]?.value ?? null;
      if (!known || !time) continue;
      const columns = [time, entry.value, entry.value + BAND * entry.std, entry.value - BAND * entry.std, cad];
      if (track.data[0].length && time <= track.data[0].at(-1)) continue;
      track.data.forEach((column, place) => column.push(columns[place]));
      if (track.data[0].length > MOST) track.data = track.data.map((column) => column.filter((_, row) => row % 2 === 1));
    }
  }

  track(name, entry) {
    let track = this.tracks.get(name);
    if (!track && this.tracks.size < 20) {
      const box = h("div", { class: "plot" });
      const figure = h("figure", { class: "chart", hidden: true }, h("figcaption", {}, `${name}, ${unit(entry.unit)}`), box);
      this.plots.append(figure);
      const chart = new Chart(box, { xLabel: "s", series: [
        { label: "estimate with its 95 % band", stroke: "blue", width: 2 }, { label: "", stroke: "blue", width: 0.5 },
        { label: "", stroke: "blue", width: 0.5 }, { label: name in this.app.config.parameters ? "CAD" : "", stroke: "grey", width: 1.5, dash: [6, 3] }],
      bands: [{ series: [2, 3], fill: "rgba(0, 114, 178, 0.18)" }] });
      track = { chart, figure, data: [[], [], [], [], []] };
      this.tracks.set(name, track);
    }
    return track ?? { data: [[], [], [], [], []] };
  }

  draw() {
    this.dirty = performance.now() - this.drawn < READABLE;
    if (this.dirty) return;
    this.drawn = performance.now();
    if (this.latest) {
      fill(this.now, table(["Parameter", "Value", "±", "Unit", "CAD", "Method", "Status", ""], Object.entries(this.latest).map(([name, entry]) => [
        name, h("output", { "data-parameter": name, "data-si": String(entry.value) }, number(entry.value, 5)), number(entry.std, 2), unit(entry.unit),
        number(this.app.config.parameters[name]?.value, 5), String(entry.method ?? ""), String(entry.status ?? ""), String(entry.reason ?? "")])));
    }
    for (const { chart, data, figure } of this.tracks.values()) {
      const first = data[0][0] ?? 0;
      figure.hidden = !data[0].length; // a single retained value is not a curve
      if (data[0].length) chart.set([data[0].map((time) => time - first), ...data.slice(1)]);
    }
  }

  async identify() {
    const name = this.picker.select.value;
    if (!name) return;
    const result = await run(this.busy, { kind: "identify", recordings: [name], methods: this.methods.filter((box) => box.checked).map((box) => box.value) }, "Comparing the methods");
    if (!result) return;
    const methods = Object.entries(result.methods ?? {});
    const names = [...new Set(methods.flatMap(([, each]) => Object.keys(each.parameters ?? {})))];
    fill(this.answer, this.choice(result, methods), names.map((parameter) => this.figure(parameter, methods)));
  }

  // The recommended method, why, and why not the others.
  choice(result, methods) {
    const others = methods.filter(([, each]) => each.not_chosen).map(([name, each]) => h("li", {}, `${name}: ${each.not_chosen}`));
    const disturbed = methods.map(([name, each]) => [name, disturbances(each.disturbance)]).filter(([, words]) => words);
    return h("div", { id: "methods-choice" },
      h("p", {}, h("strong", {}, result.best ? `Recommended method: ${result.best}` : "No method can be recommended")), h("p", {}, result.best_reason ?? ""),
      disturbed.map(([name, words]) => h("p", { "data-text": "disturbance" }, `Disturbance estimated by ${name}: ${words}.`)),
      others.length ? h("details", {}, h("summary", {}, "Why not the others"), h("ul", {}, others)) : "");
  }

  // As in the paper's figure 3: a row per method, its value with a 95 % bar, on a common scale.
  figure(parameter, methods) {
    const rows = methods.map(([method, each]) => [method, each.parameters?.[parameter], each]).filter(([, entry]) => entry);
    const known = rows.filter(([, entry]) => typeof entry.value === "number");
    const ends = known.flatMap(([, { value, std }]) => [value - BAND * (std ?? 0), value + BAND * (std ?? 0)]);
    const middle = known.map(([, { value }]) => value).sort((a, b) => a - b)[known.length >> 1] ?? 0;
    const band = BAND * (known.map(([, { std }]) => std ?? 0).sort((a, b) => a - b)[known.length >> 1] ?? 0);
    // An outlier must not shrink the others to points.
    const most = Math.max(0.3 * Math.abs(middle), 4 * band) || Infinity;
    const reach = Math.max(1e-12, 1.05 * Math.min(Math.max(...ends.map((end) => Math.abs(end - middle)), 0), most));
    const place = (value) => Math.min(100, Math.max(0, 50 + 50 * (value - middle) / reach));
    const its = unit(known[0]?.[1].unit);
    return table(["Method", "Value", "±", ""], rows.map(([method, entry, each]) => {
      const bar = h("div", { class: "interval", role: "img", "aria-label": `${number(entry.value, 5)} ± ${number(entry.std, 2)}` });
      if (typeof entry.value === "number") {
        const low = place(entry.value - BAND * (entry.std ?? 0)), high = place(entry.value + BAND * (entry.std ?? 0));
        const line = h("i"), dot = h("b");
        line.style.left = `${low}%`;
        line.style.width = `${Math.max(0.5, high - low)}%`;
        dot.style.left = `${place(entry.value)}%`;
        bar.append(line, dot);
      }
      return [method, number(entry.value, 5), number(entry.std, 2), entry.value === null || entry.value === undefined ? String(each.reason || entry.reason || "") : bar];
    }), `${parameter}${its ? `, ${its}` : ""}`);
  }
}
