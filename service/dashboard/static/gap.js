// Gap: what the model lacks, live and on a recording: its error over the noise floor, the missing torque over time and by each
// coordinate, the effects that explain it, and the result of adding one.

import { h, fill, table } from "./dom.js";
import { Chart } from "./charts.js";
import { disturbanceText, disturbances, relevance } from "./disturbance.js";
import { ask, picker, run } from "./jobs.js";
import { number, plusMinus } from "./numbers.js";
import { Strips } from "./strips.js";

const percent = (value) => (typeof value === "number" ? `${number(value, 3)} %` : "–");
const sentence = (words) => `${String(words ?? "").slice(0, 1).toUpperCase()}${String(words ?? "").slice(1)}`;
const EFFECT = /^[a-z][a-z0-9_]{0,60}(@[a-z][a-z0-9_]{0,60})?$/;

export class Gap {
  constructor(place, app) {
    this.app = app;
    this.picker = picker("Recording", "gap-recording");
    this.live = h("div", { id: "gap-live" }, h("p", { class: "quiet" }, "No result yet: effects are diagnosed while an experiment runs."));
    this.over = h("div", { class: "charts", id: "gap-strips" });
    this.strips = new Strips(this.over, app);
    this.busy = h("div");
    this.where = h("div", { id: "gap-where" });
    this.ranked = h("div", { id: "gap-ranked" });
    this.repair = h("div", { id: "gap-repair" });
    this.model = h("div", { id: "gap-model" });
    this.charts = [];
    this.effects = [];
    fill(place,
      h("h2", {}, "While it runs"), this.live, this.over,
      h("h2", {}, "On a recording"),
      h("p", { class: "row" }, this.picker.element,
        h("button", { class: "primary", id: "gap-compare", onclick: () => this.compare() }, "Where does it fail?"),
        h("button", { class: "primary", id: "gap-diagnose", onclick: () => this.diagnose() }, "What is missing?")),
      this.busy, this.repair, this.ranked, this.where,
      h("h2", {}, "The model"), this.model);
  }

  shown() {
    this.picker.load().then(() => this.showModel()).catch((error) => this.app.notice(error.message));
  }

  diagnosis(message) {
    this.latest = message;
  }

  telemetry(message) {
    for (const { gap } of message.predictions ?? []) if (gap) this.strips.add(gap);
  }

  draw() {
    if (this.latest) this.rank(this.live, this.latest, false);
    this.strips.draw();
  }

  rank(place, diagnosis, whole) {
    const key = JSON.stringify([diagnosis.verdict, diagnosis.findings, diagnosis.seconds, diagnosis.disturbance, this.effects]);
    if (place.dataset.key === key) return; // a button must not disappear while it is pressed
    place.dataset.key = key;
    const negligible = (each) => each.relevance?.negligible === true;
    const nothing = diagnosis.verdict === "missing_effect" && diagnosis.findings.length && diagnosis.findings.every(negligible);
    const verdict = nothing ? "" : { adequate: "The model is adequate.", missing_effect: "An effect is missing.",
      unknown: diagnosis.findings.length ? "The effects found do not explain all that is missing." : "Something is missing that no known effect explains.", insufficient_data: "The data are not sufficient yet." }[diagnosis.verdict] ?? "";
    const row = (each, place) => {
      const sizes = Object.entries(each.parameters ?? {}).map(([name, entry]) =>
        `${name.split(".").pop()} ${plusMinus(entry.value, entry.std, entry.unit)}`).join(", ");
      const add = this.effects.includes(each.effect) ? "added" : EFFECT.test(each.effect) ? h("button", { class: "primary", "data-add": each.effect, onclick: () => this.add(each.effect) }, "Add") : null;
      return [`${place + 1}. ${each.effect}`, sizes, typeof each.since === "number" && each.since ? `since ${number(each.since, 4)} s` : "",
        typeof each.probability === "number" ? percent(100 * each.probability) : "–", percent(each.held_out_error_closed_percent), relevance(each),
        (each.tied_with ?? []).length ? `tied with ${each.tied_with.join(", ")}` : "", add];
    };
    const rows = diagnosis.findings.map(row);
    const headings = ["Effect", "Size", "", "Probability", "Held-out error removed", "Share of the error", "Ties", ""];
    const shown = (which, caption) => {
      const some = rows.filter((_, place) => which(diagnosis.findings[place]));
      return some.length ? table(headings, some, caption) : null;
    };
    const disturbance = disturbanceText(diagnosis, this.app.config.units);
    const untried = Array.isArray(diagnosis.untried) ? diagnosis.untried : [];
    fill(place, h("p", { class: diagnosis.adequate || nothing ? "good" : "verdict" }, nothing ? sentence(diagnosis.reason) : diagnosis.reason ? `${verdict.replace(/\.$/, ":")} ${String(diagnosis.reason).replace(/\.$/, "")}.` : verdict),
      disturbance ? h("p", { "data-text": "disturbance" }, disturbance) : null,
      untried.length ? h("p", { "data-text": "untried" }, `Left untried for want of time: ${untried.join("; ")}. upright diagnose --budget SECONDS gives more.`) : null,
      shown((each) => !negligible(each)), shown(negligible, "Negligible: significant, but less than 1 % of the error"),
      whole && typeof diagnosis.innovation_ratio_before === "number" && typeof diagnosis.innovation_ratio_after === "number"
        ? h("p", {}, `Normalised innovation squared: ${number(diagnosis.innovation_ratio_before, 3)} before, ${number(diagnosis.innovation_ratio_after, 3)} after.`) : null,
      whole && diagnosis.suggested_experiment ? h("p", {}, `Next experiment: ${String(diagnosis.suggested_experiment.text ?? diagnosis.suggested_experiment.experiment ?? "")}.`) : null);
  }

  async diagnose() {
    const name = this.picker.select.value;
    if (!name) return;
    const result = await run(this.busy, { kind: "diagnose", recordings: [name] }, "Searching for missing effects");
    if (result) this.rank(this.ranked, result, true);
  }

  async compare() {
    const name = this.picker.select.value;
    if (!name) return;
    const result = await run(this.busy, { kind: "compare", recordings: [name] }, "Comparing model and measurement");
    if (!result) return;
    this.charts.forEach((chart) => chart.destroy());
    this.charts = [];
    fill(this.where, result.models.map((model) => this.fails(model)));
    this.charts.forEach((chart) => chart.draw());
  }

  fails(model) {
    const { time = [], frequency = [], state = [] } = model.fails ?? {};
    const coordinates = [...new Set(state.map((each) => each.coordinate))];
    const top = (rows, key) => [...rows].sort((a, b) => b[key] - a[key]).slice(0, 6);
    const left = disturbances(model.disturbance);
    return h("section", { class: "card wide" },
      h("h3", {}, `${model.name}: ${model.adequate ? "adequate" : "fails"}`),
      left ? h("p", {}, `Disturbance not explained by it: ${left}.`) : null,
      h("p", {}, `Normalised innovation squared ${number(model.innovation_ratio, 3)}. `, (model.summary ?? []).join(" ")),
      h("div", { class: "charts" }, coordinates.map((coordinate) => this.missing(coordinate, state.filter((each) => each.coordinate === coordinate)))),
      time.length ? table(["From", "To", "Channel", "Energy over the floor"], top(time, "energy_over_floor").map((each) =>
        [`${number(each.from, 4)}\u00a0s`, `${number(each.to, 4)}\u00a0s`, each.channel, number(each.energy_over_floor, 3)]), "Where in time") : null,
      frequency.length ? table(["From", "To", "Channel", "Power over the floor"], top(frequency, "power_over_floor").map((each) =>
        [`${number(each.from_hz, 3)}\u00a0Hz`, `${number(each.to_hz, 3)}\u00a0Hz`, each.channel, number(each.power_over_floor, 3)]), "Where in frequency") : null);
  }

  missing(coordinate, bins) {
    const box = h("div", { class: "plot" });
    const sorted = bins.map((bin) => ({ ...bin, x: 0.5 * (bin.from + bin.to) })).sort((a, b) => a.x - b.x);
    const chart = new Chart(box, { xLabel: `${coordinate}, ${bins[0].coordinate_unit}`, yLabel: bins[0].unit, series: [
      { label: "missing", stroke: "orange", width: 2, points: true },
      { label: "± 2 std", stroke: "grey", width: 0.5 }, { label: "", stroke: "grey", width: 0.5 }] }, 200);
    chart.data = [sorted.map((bin) => bin.x), sorted.map((bin) => bin.missing_force),
      sorted.map((bin) => bin.missing_force + 2 * bin.std), sorted.map((bin) => bin.missing_force - 2 * bin.std)];
    this.charts.push(chart);
    return h("figure", { class: "chart" }, h("figcaption", {}, `Missing at ${bins[0].joint}, by ${coordinate}`), box);
  }

  async add(effect) {
    const recordings = await this.picker.load().catch(() => []);
    const name = this.picker.select.value || recordings[0]?.name;
    if (!name) return this.app.notice("There is no recording yet to fit the model to.");
    fill(this.repair);
    const result = await run(this.busy, { kind: "add", effect, recordings: [name] }, `Adding ${effect}, fitted to ${name}`);
    if (result) this.showRevision(effect, result);
    await this.showModel();
  }

  showRevision(effect, result) {
    const revision = result.repair;
    if (!revision) return fill(this.repair, h("p", {}, `${effect} added.`));
    const far = revision.horizons.length - 1;
    const rows = Object.keys(revision.before.held_out).map((channel) => {
      const before = revision.before.held_out[channel][far], after = revision.after.held_out[channel][far];
      const floor = revision.floor?.held_out?.[channel]?.[far];
      const bar = h("div", { class: "fall", role: "img", "aria-label": `falls to ${percent(100 * after / before)}` }, h("i"), h("b"));
      bar.lastChild.style.width = `${Math.min(100, 100 * after / before)}%`;
      return [`${channel}, ${this.app.config.units[channel] ?? ""}`, h("output", { "data-before": channel, "data-value": before }, number(before, 3)),
        h("output", { "data-after": channel, "data-value": after }, number(after, 3)), number(floor, 3), bar];
    });
    fill(this.repair, h("section", { class: "card wide", role: "status" }, h("h3", {}, `${effect}: before and after`),
      (revision.words ?? []).map((each) => h("p", {}, each)),
      table([`Error ${number(revision.horizons[far], 2)} s ahead, held out`, "Before", "After", "Noise floor", "Remaining"], rows),
      h("p", {}, `Normalised innovation squared: ${number(revision.before.innovation_ratio, 3)} before, ${number(revision.after.innovation_ratio, 3)} after.`),
      disturbances(revision.after.disturbance) ? h("p", { "data-text": "disturbance" }, `Disturbance before: ${disturbances(revision.before.disturbance) || "–"}. After: ${disturbances(revision.after.disturbance)}.`) : null));
  }

  async showModel() {
    const { model } = await ask("api/model");
    const effects = this.effects = model?.effects ?? [];
    this.draw();
    const undo = effects.length ? h("button", { id: "gap-undo", onclick: () => this.undo() }, `Undo ${effects.at(-1)}`) : null;
    fill(this.model, h("p", {}, model ? `Added so far: ${effects.join(", ") || "nothing"}.` : "The vehicle's own model with its CAD values; no effect added yet."), undo);
  }

  async undo() {
    if (await run(this.busy, { kind: "undo" }, "Undoing")) fill(this.repair);
    await this.showModel();
  }
}
