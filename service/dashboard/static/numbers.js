// Numbers for people. The rule for a value with its standard deviation is that of estimators/numbers.py: two digits of the
// deviation, and one SI prefix or power of ten for both.

const DEGREES = 180 / Math.PI;
const READABLE = { rad: ["deg", DEGREES], "rad/s": ["deg/s", DEGREES], m: ["mm", 1000], "m/s": ["mm/s", 1000] };
const PREFIXES = { "-12": "p", "-9": "n", "-6": "µ", "-3": "m", 3: "k", 6: "M", 9: "G" };
const PREFIXABLE = /^(N|m|s|rad|V|A|W|J|Hz|Pa|ohm|H|F)(?![\w^])/;
const ONLY_SMALL = ["s", "rad"]; // units without prefixes for multiples
const WITHOUT = 5; // digits of a value without a standard deviation
const SMALL = -2, LARGE = 5; // powers of ten: below or from which there is a prefix
const MOST = 12; // decimals

// A number in readable form, or a dash if it is not a number.
export function number(value, digits = 4) {
  if (typeof value !== "number" || !Number.isFinite(value)) return "–";
  if (value !== 0 && (Math.abs(value) >= 1e6 || Math.abs(value) < 1e-3)) return value.toExponential(Math.max(0, digits - 2));
  return String(Number(value.toPrecision(digits)));
}

// A unit with superscripts.
export const unit = (words) => String(words ?? "").replace(/\^(-?[0-9]+)/g, (_, power) => power.replace("-", "⁻").replace(/[0-9]/g, (digit) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[digit]));


// The unit in which a quantity is easy to read, and the factor to it.
export const readable = (units) => READABLE[units] ?? [unit(units), 1];

const known = (value) => typeof value === "number" && Number.isFinite(value);
// The power of ten of the last digit of a standard deviation that is shown; null if there is none.
const placeOf = (std) => (known(std) && std > 0 ? Number(std.toExponential(1).split("e")[1]) - 1 : null);

function scaled(power, its) {
  const bare = its === "1" || !its ? "" : its, symbol = PREFIXABLE.exec(its)?.[1];
  if (!power) return { power, unit: unit(bare), prefixed: true };
  if (symbol && PREFIXES[power] && !(power > 0 && ONLY_SMALL.includes(symbol))) return { power, unit: unit(PREFIXES[power] + its), prefixed: true };
  return { power, unit: `10${unit(`^${power}`)} ${unit(bare)}`.trim(), prefixed: false };
}

// The power of ten that these values have in common, and the unit to which it belongs; `pairs` are [value, std].
export function scale(pairs, its) {
  const some = pairs.filter(([value]) => known(value));
  const places = some.map(([, std]) => placeOf(std)).filter((place) => place !== null);
  const largest = Math.max(0, ...some.flatMap(([value, std]) => [Math.abs(value), placeOf(std) === null ? 0 : std]));
  if (!(largest > 0)) return scaled(0, its);
  const place = places.length ? Math.min(...places) : null, lead = Number(largest.toExponential().split("e")[1]);
  if (lead >= SMALL && (place === null ? lead < LARGE : place < 1)) return scaled(0, its);
  const power = 3 * Math.floor(lead / 3);
  return scaled(place !== null && power < place ? power + 3 : power, its);
}

// A value and its standard deviation as text on a scale.
export function pair({ power }, value, std) {
  if (!known(value)) return ["–", ""];
  const place = placeOf(std);
  if (place === null) return [number(value / 10 ** power, WITHOUT), ""];
  const decimals = Math.min(Math.max(0, power - place), MOST);
  const rounded = (each) => (place > power ? Math.round(each / 10 ** place) * 10 ** (place - power) : each / 10 ** power).toFixed(decimals);
  return [rounded(value), rounded(std)];
}

// A value with its standard deviation on a scale, with the unit.
export function quantity(on, value, std) {
  const [first, second] = pair(on, value, std);
  const words = second ? `${first} ± ${second}` : first;
  if (on.prefixed) return `${words} ${on.unit}`.trim();
  return `${second ? `(${words})` : words} × ${on.unit}`;
}

// The same in this unit, to stand beside others in it.
export const plain = (value, std, its) => quantity(scaled(0, its), value, std);

// The same on its own scale.
export const plusMinus = (value, std, its) => quantity(scale([[value, std]], its), value, std);
