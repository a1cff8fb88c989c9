// The random disturbance as text: its size at each joint, its effect on a prediction, and a finding's share of the error.

import { number, unit } from "./dom.js";

const DEGREES = 180 / Math.PI;
const READABLE = { rad: ["deg", DEGREES], "rad/s": ["deg/s", DEGREES], m: ["mm", 1000], "m/s": ["mm/s", 1000] };

// A value with its standard deviation: that has two digits if its first one is a 1, else one; the value has as many places.
export function plusMinus(value, std) {
  if (typeof value !== "number" || typeof std !== "number" || !(std > 0)) return number(value, 3);
  const first = Math.floor(Math.log10(std));
  const places = -first + (std / 10 ** first < 2 ? 1 : 0);
  if (places > 20) return number(value, 3);
  const shown = (each) => (places < 0 ? String(Math.round(each * 10 ** places) * 10 ** -places) : each.toFixed(places));
  return `${shown(value)} ± ${shown(std)}`;
}

// The entry `disturbance` of identify, compare, diagnose or model add as text, with the names of the joints if there are several.
export function disturbances(found) {
  const known = Object.entries(found ?? {}).filter(([, each]) => typeof each?.rms === "number");
  return known.map(([joint, each]) => {
    const size = each.shown === false ? `none detected; less than ${number(each.rms, 2)} ${unit(each.unit)} RMS`
      : `${plusMinus(each.rms, each.rms_std)} ${unit(each.unit)} RMS, correlation time ${plusMinus(each.correlation_time, each.correlation_time_std)} s`;
    return known.length > 1 ? `${joint}: ${size}` : size;
  }).join("; ");
}

// The disturbance of a diagnosis and its effect on a prediction; empty if nothing is known.
export function disturbanceText(diagnosis, units) {
  const words = disturbances(diagnosis.disturbance);
  if (!words) return "";
  const shows = Object.values(diagnosis.disturbance).some((each) => each?.shown !== false);
  const limit = diagnosis.prediction_limit;
  const errors = Object.entries(limit?.rmse ?? {}).filter(([, error]) => typeof error === "number").map(([channel, error]) => {
    const [its, factor] = READABLE[units[channel]] ?? [unit(units[channel]), 1];
    const without = shows ? ` (${number(factor * limit.undisturbed_rmse?.[channel], 2)} ${its} without the disturbance)` : "";
    return `${number(factor * error, 2)} ${its} RMS in ${channel}${without}`;
  });
  const best = errors.length ? ` The best possible prediction ${number(limit.horizon, 3)} s ahead has an error of ${errors.join(", ")}.` : "";
  return `Disturbance: ${words}${shows ? "; no effect explains it" : ""}.${best}`;
}

// The share of the error that a finding explains, for a cell; empty if it is not known.
export function relevance(finding) {
  const known = finding.relevance;
  if (typeof known?.ahead_percent !== "number") return "";
  const share = (value) => (value < 1 ? `${number(value, 1)} %` : `${Math.round(value)} %`);
  const loop = typeof known.closed_loop_percent === "number" ? `, ${share(known.closed_loop_percent)} in closed loop` : "";
  return `${share(known.ahead_percent)} ${number(known.horizon, 3)} s ahead${loop}`;
}
