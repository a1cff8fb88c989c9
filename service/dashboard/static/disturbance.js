// The random disturbance as text: its size at each joint, its effect on a prediction, and a finding's share of the error.

import { number, plusMinus, readable, unit } from "./numbers.js";

// The entry `disturbance` of identify, compare, diagnose or model add as text, with the names of the joints if there are several.
export function disturbances(found) {
  const known = Object.entries(found ?? {}).filter(([, each]) => typeof each?.rms === "number");
  return known.map(([joint, each]) => {
    const size = each.shown === false ? `none detected; less than ${number(each.rms, 2)} ${unit(each.unit)} RMS`
      : `${plusMinus(each.rms, each.rms_std, each.unit)} RMS, correlation time ${plusMinus(each.correlation_time, each.correlation_time_std, "s")}`;
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
    const [its, factor] = readable(units[channel]);
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
