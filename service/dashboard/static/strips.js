// Strip charts of what the model lacks while the vehicle moves: its one-step errors over the noise floor, and the force that
// is missing at each joint, with a band of ± 2 standard deviations.

import { h, fill, text } from "./dom.js";
import { Chart, columns } from "./charts.js";
import { number, plusMinus, readable, unit } from "./numbers.js";
import { Rolling } from "./rolling.js";

const BAND = 2; // standard deviations
const LATEST = 2 / 3; // share of the curves that is drawn as a whole: at first, the parameters are those of the CAD
const ERROR = { label: "one-step error, RMS over 0.1 s", stroke: "orange", width: 1.5 };
const FLOOR = { label: "noise floor", stroke: "grey", width: 1.5, dash: [6, 3] };
const FORCE = { label: "missing", stroke: "orange", width: 1.5 };
const EDGES = [{ label: `± ${BAND} std`, stroke: "grey", width: 1 }, { label: "", stroke: "grey", width: 1 }];

export class Strips {
  constructor(place, app) {
    this.place = place;
    this.app = app;
    this.strips = [];
    this.key = "";
  }

  // The gap of one segment, in which value i belongs to the time t0 + i dt.
  add(gap) {
    const key = JSON.stringify([Object.keys(gap.error), Object.keys(gap.missing_force)]);
    if (key !== this.key) this.build(gap, key);
    const arrays = {};
    for (const strip of this.strips) Object.assign(arrays, strip.take(gap));
    this.rolling.add(gap.t0, gap.dt, arrays);
    this.news = true;
  }

  build(gap, key) {
    this.key = key;
    this.strips.forEach(({ chart }) => chart.destroy());
    this.strips = [
      ...Object.keys(gap.error).map((channel) => this.error(channel)),
      ...Object.entries(gap.missing_force).map(([joint, each]) => this.force(joint, each.unit)),
    ];
    this.rolling = new Rolling(this.strips.flatMap((strip) => strip.names));
    fill(this.place, this.strips.map((strip) => strip.figure));
  }

  error(channel) {
    const [its, factor] = readable(this.app.config.units[channel]);
    const names = [`error:${channel}`, `floor:${channel}`];
    const take = ({ error, floor }) => {
      const size = Math.sqrt(error[channel].reduce((sum, each) => sum + each ** 2, 0) / error[channel].length);
      return { now: `${number(size / floor[channel], 2)} × noise floor`, si: size / floor[channel],
        arrays: { [names[0]]: error[channel], [names[1]]: error[channel].map(() => floor[channel]) } };
    };
    return this.strip(`Error of ${channel}`, its, factor, names, [ERROR, FLOOR], take, { "data-error": channel });
  }

  force(joint, its) {
    const names = ["", "+", "-"].map((edge) => `force${edge}:${joint}`);
    const take = ({ missing_force: { [joint]: { values, std } } }) => ({
      now: plusMinus(values.at(-1), std.at(-1), its), si: values.at(-1),
      arrays: { [names[0]]: values, [names[1]]: values.map((value, row) => value + BAND * std[row]), [names[2]]: values.map((value, row) => value - BAND * std[row]) } });
    const what = { "N m": "torque", N: "force" }[its] ?? "load";
    return this.strip(`Missing ${what} at ${joint}`, unit(its), 1, names, [FORCE, ...EDGES], take, { "data-missing": joint });
  }

  strip(title, its, factor, names, series, read, marks) {
    const box = h("div", { class: "plot" }), now = h("output", {}, "–");
    const figure = h("figure", { class: "chart", ...marks }, h("figcaption", {}, `${title}: `, now), box);
    const chart = new Chart(box, { xLabel: "s", yLabel: its, series, ...columns(factor, LATEST) });
    const take = (gap) => {
      const { now: words, si, arrays } = read(gap);
      text(now, words);
      now.dataset.si = String(si);
      return arrays;
    };
    return { names, chart, figure, take };
  }

  draw() {
    if (!this.news) return;
    this.news = false;
    this.rolling.mark();
    for (const { names, chart } of this.strips) chart.set(this.rolling.shown(names));
  }
}
