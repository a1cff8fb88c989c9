// Recordings: a list; an overlay of one or two of them, their metadata, the files, and the report.

import { h, fill, table } from "./dom.js";
import { Chart, turned } from "./charts.js";
import { ask, run } from "./jobs.js";
import { number, plusMinus } from "./numbers.js";

const WRITTEN = 3000; // ms after an experiment until its estimates are written
const PARTS = { recording: "recording", log: "raw log", estimates: "estimates" };

export class Recordings {
  constructor(place, app) {
    this.app = app;
    this.chosen = [];
    this.list = h("div", { id: "recordings" });
    this.busy = h("div");
    this.detail = h("div", { id: "recording" });
    this.charts = [];
    fill(place, h("h2", {}, "Recordings"), h("p", { class: "quiet" }, "Open a recording; compare it with a second one as an overlay."), this.list, this.busy, this.detail);
  }

  // After an experiment there are new files.
  state(state) {
    if (this.mode === "running" && state.mode !== "running") for (const later of [0, WRITTEN]) setTimeout(() => this.shown(), later);
    this.mode = state.mode;
  }

  async shown() {
    try {
      const { recordings } = await ask("api/recordings");
      const key = JSON.stringify(recordings);
      if (key === this.listed) return; // a button must not disappear while it is pressed
      this.listed = key;
      fill(this.list, recordings.length ? table(["Recording", "Size", "", "Files", ""], recordings.map((each) => this.row(each))) : h("p", {}, "None yet."));
    } catch (error) {
      this.app.notice(error.message);
    }
  }

  row(each) {
    const path = `api/recordings/${encodeURIComponent(each.name)}`;
    const files = Object.entries(PARTS).filter(([part]) => part === "recording" || each[part]).map(([part, label]) =>
      h("a", { href: `${path}/${part}`, download: "" }, label));
    return [each.name, `${number(each.bytes / 1e6, 2)} MB`,
      h("span", { class: "row" }, h("button", { "data-open": each.name, onclick: () => this.open([each.name]) }, "Open"),
        h("button", { "data-compare": each.name, onclick: () => this.open([this.chosen[0] ?? each.name, each.name]) }, "Compare")),
      h("span", { class: "row" }, files), h("button", { "data-report": each.name, onclick: () => this.report(each.name) }, "Report")];
  }

  async open(names) {
    this.chosen = [...new Set(names)].slice(0, 2);
    try {
      this.opened = await Promise.all(this.chosen.map((name) => ask(`api/recordings/${encodeURIComponent(name)}?points=2000`)));
    } catch (error) {
      return fill(this.detail, h("p", { class: "bad", role: "alert" }, error.message));
    }
    this.charts.forEach((chart) => chart.destroy());
    this.charts = [];
    const seen = new Set();
    const figures = this.app.config.charts.flatMap((chart) => chart.curves.filter((curve) =>
      ["measured", "setpoint"].includes(curve.look) && !seen.has(curve.channel) && seen.add(curve.channel)).map((curve) => this.figure(chart, curve)));
    fill(this.detail, this.opened.map((each) => this.facts(each)), h("div", { class: "charts" }, figures));
    this.draw();
  }

  facts(each) {
    const methods = Object.entries(each.estimates?.methods ?? {});
    const rows = methods.flatMap(([method, found]) => Object.entries(found.parameters ?? {}).map(([name, entry]) =>
      [method, name, plusMinus(entry.value, entry.std, entry.unit)]));
    return h("section", { class: "card wide" }, h("h3", {}, each.name),
      h("p", {}, `${number(each.seconds, 4)} s, ${each.rows} samples. Experiment ${each.metadata.experiment ?? "–"}, ended: ${each.metadata.end_reason || "as planned"}. ${each.truncated}`),
      rows.length ? h("details", {}, h("summary", {}, "Live estimates"), table(["Method", "Parameter", "Value"], rows)) : null);
  }

  figure(chart, curve) {
    const box = h("div", { class: "plot" });
    const looks = [{ stroke: "blue", width: 1.5 }, { stroke: "orange", width: 1.5, dash: [5, 3] }];
    const plot = new Chart(box, { xLabel: "s", yLabel: chart.unit, series: this.opened.map((each, place) => ({ label: each.name, ...looks[place] })) });
    const tables = this.opened.map((each) => [each.time, turned(each.channels[curve.channel]?.values ?? each.time.map(() => null), chart.factor)]);
    plot.data = tables.length > 1 ? uPlot.join(tables) : tables[0];
    if (tables.length > 1) plot.options.series.forEach((each) => { each.gaps = true; }); // the sampling times of one are gaps in the other
    this.charts.push(plot);
    const title = curve.look === "setpoint" ? `${chart.title}, ${curve.label}` : chart.title;
    return h("figure", { class: "chart" }, h("figcaption", {}, `${title}, ${chart.unit}`), box);
  }

  draw() {
    for (const chart of this.charts) chart.draw();
  }

  async report(name) {
    const result = await run(this.busy, { kind: "report", recordings: [name] }, `Writing the report on ${name}`);
    if (!result) return;
    const stem = name.replace(/\.[^.]*$/, "");
    fill(this.busy, h("p", { class: "good", role: "status" }, "The report is ready: ",
      h("a", { href: `reports/${encodeURIComponent(stem)}.html`, target: "_blank", rel: "noopener" }, `${stem}.html`)));
  }
}
