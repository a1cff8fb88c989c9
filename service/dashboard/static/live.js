// Live: the motion of the vehicle, and the model's prediction.

import { h, fill, text } from "./dom.js";
import { Chart, columns } from "./charts.js";
import { Rolling } from "./rolling.js";
import { number } from "./numbers.js";

const READABLE = 200; // ms, refresh period of a figure: each change needs a new layout of the page

const source = (curve) => (curve.look === "predicted" || curve.look === "innovation" ? `${curve.look}:${curve.channel}` : curve.channel);

export class Live {
  constructor(place, app) {
    this.app = app;
    const charts = app.config.charts;
    this.sources = Object.fromEntries(charts.map((chart) => [chart.id, chart.curves.map(source)]));
    this.rolling = new Rolling([...new Set(Object.values(this.sources).flat())]);
    this.values = {};
    this.refreshed = 0;
    this.events = [];
    this.interlocks = h("ul", { id: "interlocks" }, h("li", { class: "quiet" }, "No data from the vehicle yet."));
    this.figures = Object.fromEntries(["rate", "missed", "longest", "load", "held", "limit"].map((name) => [name, h("dd", { id: `figure-${name}` }, "–")]));
    this.now = Object.fromEntries(charts.map((chart) => [chart.id, h("output", { id: `value-${chart.id}` }, "–")]));
    this.log = h("ol", { id: "events", class: "log" });
    this.none = h("p", { class: "quiet" }, "None since this page was opened.");
    const boxes = charts.map((chart) => {
      const box = h("div", { class: "plot" });
      const last = chart.curves[0];
      const figure = h("figure", { class: "chart" },
        h("figcaption", {}, last.look === "innovation" ? `${chart.title}, ` : [chart.title, " ", this.now[chart.id], " "], chart.unit), box);
      this.values[chart.id] = new Chart(box, { xLabel: "s", yLabel: chart.unit, series: chart.curves, ...columns(chart.factor) });
      return figure;
    });
    fill(place,
      h("div", { class: "cards" },
        h("section", { class: "card", "aria-label": "State" }, h("h2", {}, "Interlocks"), this.interlocks),
        h("section", { class: "card", "aria-label": "Loop" }, h("h2", {}, "Control loop"), h("dl", {},
          h("dt", {}, "rate"), this.figures.rate, h("dt", {}, "missed cycles"), this.figures.missed,
          h("dt", {}, "longest step"), this.figures.longest, h("dt", {}, "bus load"), this.figures.load,
          h("dt", {}, "held by"), this.figures.held, h("dt", {}, "nearest limit"), this.figures.limit)),
        h("section", { class: "card", "aria-label": "Events" }, h("h2", {}, "Events"), this.none, this.log)),
      h("div", { class: "charts" }, boxes));
  }

  state(state) {
    const words = [...state.faults.map((fault) => h("li", { class: "bad" }, `Fault: ${fault.text}`)), ...[...state.interlocks, ...(state.stays_down ?? [])].map((each) => h("li", {}, each))];
    fill(this.interlocks, words.length ? words : h("li", { class: "good" }, "None: an experiment can be started."));
    text(this.figures.held, this.app.named(state.held_by || "nobody"));
  }

  telemetry(message) {
    this.rolling.add(message.t0, message.dt, message);
    for (const segment of message.predictions ?? []) {
      for (const [name, values] of Object.entries(segment.values)) this.rolling.merge(segment.t0, segment.dt, `predicted:${name}`, values);
      for (const [name, values] of Object.entries(segment.innovations)) this.rolling.merge(segment.t0, segment.dt, `innovation:${name}`, values);
    }
    const health = message.health;
    if (health && typeof health === "object") {
      const wanted = this.app.config.rate;
      text(this.figures.rate, `${number(health.rate, 4)} of ${wanted} Hz`);
      text(this.figures.missed, number(health.missed_cycles, 9));
      text(this.figures.longest, typeof health.longest_step === "number" ? `${number(1e3 * health.longest_step, 3)} ms` : "–");
      text(this.figures.load, Array.isArray(health.buses) && health.buses.length
        ? health.buses.map((bus) => `${number(bus.load_percent, 3)} %`).join(", ") : "–");
      const near = health.nearest_limit;
      text(this.figures.limit, near ? `${near.code.replaceAll("_", " ")}, ${number(near.percent, 3)} % used` : "–");
    }
  }

  event(event) {
    this.none.hidden = true;
    this.events.unshift(event);
    this.events.length = Math.min(this.events.length, 30);
    fill(this.log, this.events.map((each) => h("li", { "data-severity": each.severity }, each.text)));
  }

  draw() {
    if (!this.rolling.length) return;
    const due = performance.now() - this.refreshed > READABLE;
    if (due) this.refreshed = performance.now();
    this.rolling.mark();
    for (const chart of this.app.config.charts) {
      this.values[chart.id].set(this.rolling.shown(this.sources[chart.id]));
      const last = this.rolling.last(this.sources[chart.id][0]), output = this.now[chart.id];
      if (due) text(output, Number.isNaN(last) ? "–" : (last * chart.factor).toFixed(2));
      output.dataset.si = String(last);
      output.dataset.time = String(this.rolling.newest);
    }
  }
}
