// Identify: the live estimates of the parameters by method, where the methods part, and all methods side by side for a recording.

import { h, fill, table } from "./dom.js";
import { Chart, colour } from "./charts.js";
import { disturbances } from "./disturbance.js";
import { picker, run } from "./jobs.js";
import { pair, quantity, scale, unit } from "./numbers.js";

const BAND = 1.96; // standard deviations of a 95 % band
const LIVE_BAND = 2; // standard deviations of a live band: the number by which methods part
const LOOKS = {
  recursive_prediction_error: { stroke: "blue", width: 2 },
  recursive_output_error: { stroke: "orange", width: 1.5, dash: [8, 3] },
  recursive_least_squares: { stroke: "green", width: 1.5, dash: [2, 2] },
  recursive_instrumental_variables: { stroke: "purple", width: 1.5, dash: [8, 3, 2, 3] },
};
const OTHER = { stroke: "grey", width: 1.5 };
const RULE = "Two methods part where they differ by more than twice the standard deviation of their difference, taken as that of independent estimates. For a moment that may be chance. If it lasts, at least one of them is biased: by an effect that the model lacks, by noise in the regressors (least squares), or by noise that drives the vehicle (output error).";
const READABLE = 1000; // ms, refresh period of a table
const MOST = 600; // points of a curve; beyond that every second one is dropped

// The range of the later two thirds of the curves: the wide bands of the first seconds, and a CAD value far off, would make
// one line of the methods.
function later(plot, least, most) {
  const curves = plot.data.slice(2).flatMap((column) => column.slice(Math.floor(column.length / 3))).filter((value) => value !== null);
  const low = curves.length ? Math.min(...curves) : least ?? -1, high = curves.length ? Math.max(...curves) : most ?? 1;
  const room = 0.08 * (high - low) || 0.05 * Math.abs(high) || 1;
  return [low - room, high + room];
}

export class Identify {
  constructor(place, app) {
    this.app = app;
    this.tracks = new Map();
    this.drawn = 0;
    this.plots = h("div", { class: "charts" });
    this.parting = h("div", { id: "parting" });
    this.now = h("div", { id: "parameters-now" }, h("p", { class: "quiet" }, "No estimates yet: they appear while an experiment runs."));
    this.picker = picker("Recording", "identify-recording");
    this.answer = h("div", { id: "methods" });
    this.busy = h("div");
    this.boxes = app.config.methods.map((name) => h("input", { type: "checkbox", name: "method", value: name }));
    const methods = h("details", {}, h("summary", {}, "Which methods"), h("p", { class: "quiet" }, "None selected: all that suit the recording."),
      h("div", { class: "row" }, this.boxes.map((box) => h("label", {}, box, ` ${box.value.replaceAll("_", " ")}`))));
    const button = h("button", { class: "primary", id: "identify-run", onclick: () => this.identify() }, "Compare the methods");
    fill(place, h("h2", {}, "While it runs"), this.now, this.plots, this.parting,
      h("h2", {}, "Methods side by side"), h("p", { class: "row" }, this.picker.element, button), methods, this.busy, this.answer);
  }

  shown() {
    this.picker.load().catch(() => {});
  }

  state(state) {
    if (state.mode === "running" && this.running !== state.since) {
      this.running = state.since;
      for (const track of this.tracks.values()) track.data = track.data.map(() => []);
    }
  }

  parameters(parameters) {
    this.latest = parameters;
  }

  methods({ estimates, parting }) {
    this.parts = parting;
    this.compared = Object.values(estimates).filter((each) => Object.values(each).some((entry) => typeof entry.value === "number")).length;
    const time = this.app.newest ?? 0;
    if (!time) return;
    const names = [...new Set(Object.values(estimates).flatMap((each) => Object.keys(each)))];
    for (const name of names) this.extend(name, time, Object.entries(estimates).flatMap(([method, each]) => (each[name] ? [[method, each[name]]] : [])));
  }

  // One more point of a parameter, with the estimates of its methods: columns are time, CAD, and value and band of each method.
  extend(name, time, entries) {
    const known = new Map(entries.filter(([, { value, std }]) => typeof value === "number" && typeof std === "number"));
    if (!known.size) return;
    const track = this.track(name, entries[0][1].unit, [...known.keys()]);
    if (!track || (track.data[0].length && time <= track.data[0].at(-1))) return;
    const point = [time, this.app.config.parameters[name]?.value ?? null];
    for (const method of track.methods) {
      const { value, std } = known.get(method) ?? {};
      point.push(...(value === undefined ? [null, null, null] : [value, value + LIVE_BAND * std, value - LIVE_BAND * std]));
    }
    track.data.forEach((column, place) => column.push(point[place]));
    if (track.data[0].length > MOST) track.data = track.data.map((column) => column.filter((_, row) => row % 2 === 1));
  }

  // The curves of a parameter. Its chart is made again when a further method determines the parameter.
  track(name, units, methods) {
    let track = this.tracks.get(name);
    if (!track) {
      if (this.tracks.size >= 20) return null;
      const box = h("div", { class: "plot" });
      const figure = h("figure", { class: "chart", hidden: true, "data-course": name }, h("figcaption", {}, `${name}, ${unit(units)}`), box);
      this.plots.append(figure);
      track = { box, figure, chart: null, methods: [], data: [[], []] };
      this.tracks.set(name, track);
    }
    const further = methods.filter((method) => !track.methods.includes(method));
    if (further.length) {
      track.methods.push(...further);
      for (let column = 3 * further.length; column > 0; column -= 1) track.data.push(track.data[0].map(() => null));
      track.chart?.destroy();
      track.chart = this.chart(name, track);
      track.figure.dataset.methods = track.methods.join(" ");
    }
    return track;
  }

  chart(name, { box, methods }) {
    const cad = { label: name in this.app.config.parameters ? "CAD" : "", stroke: "grey", width: 1.5, dash: [6, 3] };
    const curves = methods.flatMap((method) => {
      const look = LOOKS[method] ?? OTHER, edge = { label: "", stroke: look.stroke, width: 0.5 };
      return [{ label: method.replaceAll("_", " "), ...look }, edge, edge];
    });
    const bands = methods.map((method, place) => ({ series: [3 * place + 3, 3 * place + 4], fill: () => `${colour((LOOKS[method] ?? OTHER).stroke)}22` }));
    return new Chart(box, { xLabel: "s", series: [cad, ...curves], bands, scales: { y: { range: later } } });
  }

  draw() {
    this.dirty = performance.now() - this.drawn < READABLE;
    if (this.dirty) return;
    this.drawn = performance.now();
    if (this.latest) {
      fill(this.now, table(["Parameter", "Value", "CAD", "Method", "Status", ""], Object.entries(this.latest).map(([name, entry]) => this.row(name, entry))));
    }
    if (this.parts) fill(this.parting, this.words());
    for (const { chart, data, figure } of this.tracks.values()) {
      const first = data[0][0] ?? 0;
      figure.hidden = !data[0].length; // a single retained value is not a curve
      if (data[0].length) chart.set([data[0].map((time) => time - first), ...data.slice(1)]);
    }
  }

  // An estimate beside the CAD value, both on one scale.
  row(name, { value, std, unit: its, method, status, reason }) {
    const given = this.app.config.parameters[name] ?? {}, on = scale([[value, std], [given.value, given.std]], its);
    return [name, h("output", { "data-parameter": name, "data-si": String(value) }, quantity(on, value, std)),
      given.value === undefined ? "–" : quantity(on, given.value, given.std), String(method ?? ""), String(status ?? ""), String(reason ?? "")];
  }

  // Where the methods part, in the sentences of the service.
  words() {
    if (this.compared < 2) return [];
    const found = this.parts.map((each) => h("li", { "data-parting": each.parameter }, each.text));
    return [h("h2", {}, "Where the methods part"), found.length ? h("ul", {}, found) : h("p", { class: "good" }, "Nowhere: all methods agree within their standard deviations."),
      h("p", { class: "quiet" }, `Curves with bands of ± ${LIVE_BAND} standard deviations. ${RULE}`)];
  }

  async identify() {
    const name = this.picker.select.value;
    if (!name) return;
    const result = await run(this.busy, { kind: "identify", recordings: [name], methods: this.boxes.filter((box) => box.checked).map((box) => box.value) }, "Comparing the methods");
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
    const common = scale(rows.map(([, entry]) => [entry.value, entry.std]), rows[0]?.[1].unit);
    return table(["Method", "Value", "±", ""], rows.map(([method, entry, each]) => {
      const [value, std] = pair(common, entry.value, entry.std);
      const bar = h("div", { class: "interval", role: "img", "aria-label": `${value} ± ${std}` });
      if (typeof entry.value === "number") {
        const low = place(entry.value - BAND * (entry.std ?? 0)), high = place(entry.value + BAND * (entry.std ?? 0));
        const line = h("i"), dot = h("b");
        line.style.left = `${low}%`;
        line.style.width = `${Math.max(0.5, high - low)}%`;
        dot.style.left = `${place(entry.value)}%`;
        bar.append(line, dot);
      }
      return [method, h("output", { "data-si": String(entry.value) }, value), std, entry.value === null || entry.value === undefined ? String(each.reason || entry.reason || "") : bar];
    }), `${parameter}${common.unit ? `, ${common.unit}` : ""}`);
  }
}
