// Commissioning: the step that comes next with its one button, what came of the last one, all steps, and all experiments.
// A step's experiment is run by this page, which holds its lease; a job of the server evaluates its recording.

import { h, fill, seconds, text } from "./dom.js";
import { Experiments, asked, describe, obstacle, stays } from "./experiments.js";
import { run } from "./jobs.js";
import { acceptance, badge, file, found, isDone, prepare, purpose, wasCarriedOut } from "./step.js";

const SHORTEST = 3, LONGEST = 500; // characters of a reason
const BEGIN = "-"; // in place of a step's id while a new commissioning begins
const BUSY = "A step is being carried out";

export class Commissioning {
  constructor(place, app) {
    this.app = app;
    this.place = place;
    this.steps = [];
    this.active = null; // id of the step that is being carried out
    this.last = null; // id of the step that was carried out last on this page
    this.alert = h("p", { id: "announcement", class: "announcement", role: "alert" });
    this.top = h("div", { id: "top" });
    this.all = h("ol", { id: "steps", class: "steps" });
    this.count = h("h2");
    const experiments = h("div");
    this.experiments = new Experiments(experiments, app);
    this.folded = h("details", { id: "all-experiments" }, h("summary", {}, "All experiments"));
    this.parts = { experiments, whole: [this.top, this.count, this.all, this.folded] };
    this.bar = h("progress", { id: "step-progress", max: 1, value: 0, "aria-label": "Progress of the experiment" });
    this.what = h("p");
    this.running = h("div", { id: "step-running", hidden: true }, this.what, this.bar,
      h("p", { class: "quiet" }, "This page holds the experiment: keep it open and visible. Stop or Escape ends it in order."));
    this.busy = h("div", { id: "step-busy" });
    this.activity = h("div", { class: "activity" }, this.running, this.busy);
    this.why = h("p", { id: "why-not", class: "quiet" });
    this.reset = h("button", { id: "step-reset", hidden: true, onclick: () => this.acknowledge() }, "Reset the fault: its cause has been removed");
    this.form = this.skipForm();
    new ResizeObserver(([header]) => place.style.setProperty("--head", `${header.target.offsetHeight}px`)).observe(document.querySelector("header"));
    fill(place, this.alert, experiments);
  }

  // Messages

  commissioning(message) {
    const key = JSON.stringify(message);
    if (key === this.key) return;
    if (!this.key) {
      this.folded.append(this.parts.experiments);
      fill(this.place, this.alert, this.parts.whole);
    }
    this.key = key;
    this.steps = message.steps;
    this.next = message.next;
    this.began = message.began;
    this.render();
  }

  state(state) {
    this.experiments.state(state);
    text(this.alert, (state.mode === "running" && asked(state)) || "");
    this.refresh();
  }

  progress(message) {
    this.experiments.progress(message);
    if (this.app.state?.mode !== "running") return;
    this.bar.value = Math.min(1, Math.max(0, message.fraction));
    text(this.what, `${message.task}: ${this.app.state.phase}, ${Math.round(100 * this.bar.value)} %, ${seconds(message.remaining)} left`);
  }

  // Steps

  find(id) {
    return this.steps.find((each) => each.id === id);
  }

  title(step) {
    return `${this.steps.indexOf(step) + 1}. ${step.title}`;
  }

  lacking(step) {
    return step.needs.map((id) => this.find(id)).filter((each) => each && !isDone(each)).map((each) => this.title(each));
  }

  // Why a step cannot be carried out now; empty if it can.
  obstacle(step) {
    if (this.active) return BUSY;
    const lacking = this.lacking(step);
    if (lacking.length) return `Waits for ${lacking.join(", ")}`;
    if (!step.experiment) return "";
    return this.app.config.experiments[step.experiment] ? obstacle(this.app.state) : `The vehicle file has no experiment ${step.experiment}`;
  }

  async carryOut(step) {
    if (this.obstacle(step)) return;
    this.occupy(step.id);
    let recording;
    if (step.experiment) {
      const reply = await this.experiment(step.experiment);
      recording = typeof reply.recording === "string" ? reply.recording.split("/").pop() : undefined;
      if (!reply.ok || reply.text || !recording) return this.release(this.missed(step, reply));
    }
    await this.evaluate(step, recording);
  }

  // Runs the experiment and holds its lease; returns its last reply.
  async experiment(name) {
    this.bar.value = 0;
    text(this.what, `${name}: starting`);
    this.running.hidden = false;
    const reply = await new Promise((resolve) => {
      this.app.link.experiment(name, resolve).then((first) => (!first.ok || first.done) && resolve(first));
    });
    this.running.hidden = true;
    return reply;
  }

  missed(step, reply) {
    const words = this.app.named(reply.text || "there is no recording").replace(/\.$/, "");
    return h("p", { class: "bad", role: "alert" }, `Not evaluated, as experiment ${step.experiment} ${reply.ok ? "ended early" : "failed"}: ${words}.`);
  }

  async evaluate(step, recording) {
    this.occupy(step.id);
    const result = await run(this.busy, { kind: "commission", step: step.id, ...(recording ? { recording } : {}) }, recording ? `Evaluating ${recording}` : "Carrying it out");
    const again = recording && !result ? h("button", { onclick: () => this.evaluate(step, recording) }, "Evaluate this recording again") : null;
    this.release(again, result ? this.said(result) : null);
  }

  // Jobs without an experiment: a step is skipped, a commission begins.
  async record(id, what, words) {
    this.occupy(id);
    const result = await run(this.busy, what, words);
    this.release(result ? this.said(result) : null);
  }

  said(result) {
    const fine = (result.exit_code ?? 0) === 0;
    return typeof result.text === "string" && result.text ? h("p", { class: fine ? "good" : "verdict", role: "status" }, this.app.named(result.text)) : null;
  }

  occupy(id) {
    this.active = this.last = id;
    this.form.hidden = true;
    fill(this.busy);
    this.render();
    this.activity.scrollIntoView({ block: "nearest" });
  }

  release(...words) {
    this.active = null;
    this.busy.append(...words.filter(Boolean));
    this.render();
    if (document.activeElement === document.body) this.top.querySelector("h2")?.focus({ preventScroll: true });
    this.top.scrollIntoView({ block: "nearest" });
  }

  async acknowledge() {
    const reply = await this.app.link.command("reset");
    if (!reply.ok) this.app.notice(`${reply.code}: ${reply.text}`);
  }

  // Skipping

  skipForm() {
    const reason = h("textarea", { id: "skip-reason", rows: 2, required: true, minlength: SHORTEST, maxlength: LONGEST, "data-act": "skip-reason", "aria-describedby": "skip-help" });
    const send = h("button", { id: "skip-send", disabled: true }, "Skip this step");
    reason.addEventListener("input", () => { send.disabled = reason.value.trim().length < SHORTEST; });
    const form = h("form", { id: "skip-form", class: "skip", hidden: true, onsubmit: (event) => {
      event.preventDefault();
      const step = this.find(this.next), words = reason.value.trim();
      if (!step || this.active || words.length < SHORTEST) return;
      reason.value = "";
      send.disabled = true;
      this.record(step.id, { kind: "skip", step: step.id, reason: words }, "Skipping");
    } },
    h("label", { for: "skip-reason" }, "Why is this step skipped?"), reason,
    h("p", { id: "skip-help", class: "quiet" }, "The reason is kept in the record and in the report."),
    h("span", { class: "row" }, send, h("button", { type: "button", onclick: () => this.ask(false) }, "Do not skip")));
    return form;
  }

  ask(open) {
    this.form.hidden = !open;
    (open ? this.form.querySelector("textarea") : this.top.querySelector("#skip"))?.focus();
  }

  // What is shown. A button keeps the focus if the list is made anew.

  render() {
    const focused = document.activeElement?.dataset?.act;
    const open = new Set([...this.all.querySelectorAll("details[open]")].map((each) => each.dataset.step));
    const shown = this.find(this.active ?? this.next);
    const before = !this.active && this.last && this.last !== this.next ? this.find(this.last) : null;
    this.form.hidden ||= this.form.dataset.step !== this.next;
    this.form.dataset.step = this.next ?? "";
    fill(this.top, before ? this.outcome(before) : null, shown ? this.card(shown, !before) : this.completed(!before));
    text(this.count, `All steps: ${this.steps.filter(isDone).length} of ${this.steps.length} done`);
    fill(this.all, this.steps.map((step) => this.item(step, open.has(step.id))));
    this.refresh();
    if (focused && document.activeElement === document.body) this.place.querySelector(`[data-act="${CSS.escape(focused)}"]`)?.focus();
  }

  // What depends on the state of the vehicle only.
  refresh() {
    for (const button of this.place.querySelectorAll("[data-carry]")) {
      const why = this.obstacle(this.find(button.dataset.carry));
      button.disabled = Boolean(why);
      button.title = why;
    }
    for (const button of this.place.querySelectorAll("[data-quiet]")) {
      button.disabled = Boolean(this.active);
      button.title = this.active ? BUSY : "";
    }
    const next = this.find(this.active ?? this.next);
    const why = next && !this.active ? this.obstacle(next) : "";
    text(this.why, why ? `Not possible now: ${why.replace(/\.$/, "")}.` : "");
    this.reset.hidden = !(next?.experiment && this.app.state?.mode === "fault" && this.app.state.commands);
  }

  outcome(step) {
    return h("section", { id: "step-outcome", class: "card wide outcome", "data-state": step.state, "aria-label": "The last step" },
      h("h2", { tabindex: -1 }, `${this.title(step)} `, badge(step)), this.activity, acceptance(step), found(step),
      h("button", { onclick: () => { this.last = null; fill(this.busy); this.render(); } }, "Close"));
  }

  button(step, words, looks = "") {
    return h("button", { class: looks, "data-carry": step.id, "data-act": `${looks}-${step.id}`, onclick: () => this.carryOut(this.find(step.id)) },
      words ?? (step.experiment ? "Run and evaluate" : "Carry out"));
  }

  // While it is carried out, what happens comes first; afterwards what was found, before what it was for.
  card(step, withActivity) {
    const primary = this.button(step, null, "primary");
    primary.id = "carry-out";
    primary.setAttribute("aria-describedby", "why-not");
    const skip = h("button", { id: "skip", class: "unobtrusive", "data-quiet": "", "data-act": "skip", onclick: () => this.ask(true) }, "Skip …");
    const place = `step ${this.steps.indexOf(step) + 1} of ${this.steps.length}`;
    return h("section", { id: "next-step", class: "card wide next", "data-step": step.id, "aria-labelledby": "next-title" },
      h("p", { class: "quiet" }, step.id === this.next ? `Next: ${place}` : `Again: ${place}`),
      h("h2", { id: "next-title", tabindex: -1 }, step.title, " ", badge(step, this.active === step.id)),
      withActivity ? this.activity : null,
      wasCarriedOut(step) ? [acceptance(step), found(step)] : null,
      purpose(step, wasCarriedOut(step) || this.active !== null), prepare(step), this.runs(step),
      wasCarriedOut(step) ? null : acceptance(step),
      this.active ? null : [h("div", { class: "row go" }, primary, step.id === this.next ? skip : null), this.why, this.reset, this.form]);
  }

  runs(step) {
    const experiment = this.app.config.experiments[step.experiment];
    return experiment ? h("p", {}, h("strong", {}, `Experiment ${step.experiment}: `), `${experiment.title} (${describe(experiment, this.app.config.amplitude_unit)}) `, stays(experiment)) : null;
  }

  completed(withActivity) {
    const skipped = this.steps.filter((each) => each.state === "skipped").length;
    const sure = h("div", { class: "row", hidden: true }, "All steps will be open again. The record of this commissioning is kept. ",
      h("button", { id: "begin-sure", class: "primary", "data-quiet": "", onclick: () => this.begin() }, "Begin"), h("button", { onclick: () => { sure.hidden = true; } }, "Do not begin"));
    return h("section", { id: "completed", class: "card wide next" }, h("h2", { tabindex: -1 }, "All steps are done"),
      h("p", { class: "good" }, `✓ ${this.steps.length - skipped} accepted${skipped ? `, ${skipped} skipped with a reason` : ""}.`, this.began ? ` Begun ${this.began} UTC.` : ""),
      h("p", {}, "The report, to read, sign and file: ", file("commissioning/report.html")), withActivity ? this.activity : null,
      h("div", { class: "row go" }, h("button", { id: "begin", "data-quiet": "", "data-act": "begin", onclick: () => { sure.hidden = false; sure.querySelector("button").focus(); } }, "Begin a new commissioning")), sure);
  }

  begin() {
    return this.record(BEGIN, { kind: "begin" }, "Beginning");
  }

  item(step, open) {
    const lacking = this.lacking(step);
    const again = step.id === this.next ? h("p", { class: "quiet" }, "This step comes next: its button is above.")
      : this.button(step, step.state === "accepted" ? "Repeat" : null);
    return h("li", {}, h("details", { "data-step": step.id, open },
      h("summary", { "data-act": `open-${step.id}` }, h("span", { class: "name" }, this.title(step)), " ", badge(step, this.active === step.id)),
      h("div", { class: "body" }, purpose(step), prepare(step), this.runs(step), acceptance(step), found(step), again,
        lacking.length ? h("p", { class: "quiet" }, `Waits for ${lacking.join(", ")}.`) : null)));
  }
}
