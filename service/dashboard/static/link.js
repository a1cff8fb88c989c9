// The connection to the broker. Received messages are checked before use, commands carry an id and a time, and an
// experiment needs a lease, which this page renews while it is open.

const LARGEST = 200_000; // characters of a message
const RENEWAL = 75; // ms between two renewals
const PATIENCE = 5000; // ms, timeout of a reply
const SLOW = 6000; // ms for which a link that had to catch up is reported as slow
const LATEST = 2; // s, delay of telemetry beyond which it is left out until the link has caught up

const random = () => Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");
const decoder = new TextDecoder();
const isObject = (value) => typeof value === "object" && value !== null && !Array.isArray(value);
const isText = (value) => typeof value === "string";
const isNumber = (value) => typeof value === "number" && Number.isFinite(value);

const CHECKS = {
  state: (m) => isText(m.mode) && [m.interlocks, m.stays_down ?? []].every((each) => Array.isArray(each) && each.every(isText)) && Array.isArray(m.faults),
  telemetry: isTelemetry,
  parameters: (m) => Object.values(m).every((entry) => isObject(entry) && "value" in entry),
  methods: (m) => isObject(m.estimates) && Object.values(m.estimates).every((each) => isObject(each) && Object.values(each).every(isObject)) &&
    Array.isArray(m.parting) && m.parting.every((each) => isObject(each) && isText(each.text)),
  diagnosis: (m) => isText(m.verdict) && Array.isArray(m.findings) && m.findings.every((each) => isObject(each) && isText(each.effect)),
  commissioning: (m) => Array.isArray(m.steps) && m.steps.length > 0 && m.steps.every(isStep) && (m.next === null || m.steps.some((each) => each.id === m.next)),
  progress: (m) => isNumber(m.fraction) && isText(m.task),
  event: (m) => isText(m.severity) && isText(m.text),
};

const STEP = ["id", "title", "why", "why_now", "prepare", "experiment", "state", "date", "by", "reason", "recording"];
const ACCEPTANCE = ["quantity", "title", "unit", "limits", "remedy"];

function isStep(step) {
  return isObject(step) && STEP.every((key) => isText(step[key])) &&
    [step.needs, step.text].every((each) => Array.isArray(each) && each.every(isText)) &&
    isObject(step.files) && isObject(step.numbers) && Object.values(step.numbers).every(isObject) &&
    Array.isArray(step.acceptance) && step.acceptance.every((each) => isObject(each) && ACCEPTANCE.every((key) => isText(each[key])));
}

// Keys of a batch that are not columns.
const BESIDES = new Set(["t0", "dt", "health", "predictions"]);

function isTelemetry(message) {
  if (!isNumber(message.t0) || !isNumber(message.dt) || message.dt <= 0) return false;
  let rows = 0;
  for (const key in message) {
    if (BESIDES.has(key)) continue;
    const value = message[key];
    if (!Array.isArray(value) || value.length > 5000 || (rows && value.length !== rows)) return false;
    for (let row = 0; row < value.length; row += 1) if (value[row] !== null && !isNumber(value[row])) return false;
    rows = value.length;
  }
  const predictions = message.predictions ?? [];
  return rows > 0 && Array.isArray(predictions) && predictions.every((each) =>
    isObject(each) && isNumber(each.t0) && isNumber(each.dt) && isObject(each.values) && isObject(each.innovations) &&
    [...Object.values(each.values), ...Object.values(each.innovations)].every(Array.isArray) && (each.gap === undefined || isGap(each.gap)));
}

const areNumbers = (list) => Array.isArray(list) && list.length > 0 && list.length <= 1000 && list.every(isNumber);

function isGap(gap) {
  return isObject(gap) && isNumber(gap.t0) && isNumber(gap.dt) && gap.dt > 0 && isObject(gap.error) && isObject(gap.floor) && isObject(gap.missing_force) &&
    Object.entries(gap.error).every(([channel, list]) => areNumbers(list) && isNumber(gap.floor[channel])) &&
    Object.values(gap.missing_force).every((each) => isObject(each) && areNumbers(each.values) && areNumbers(each.std) && isText(each.unit));
}

// The time of the last sample of a batch.
export function newest(message) {
  for (const key in message) if (!BESIDES.has(key)) return message.t0 + (message[key].length - 1) * message.dt;
  return message.t0;
}

export class Link {
  constructor(config, handlers) {
    this.page = `page-${random()}`;
    this.ignored = { malformed: 0, huge: 0, reordered: 0 };
    this.online = false; // the vehicle's own status, or its last will
    this.connected = false;
    this.trouble = "connecting";
    this.config = config;
    this.handlers = handlers;
    this.waiting = new Map();
    this.held = null; // id of the experiment that this page holds
    this.latest = -Infinity;
    this.late = 0; // s by which telemetry is later than at its subscription; clocks may differ
    this.usual = Infinity;
    this.catchingUp = false;
    this.worst = 0; // the largest delay of a link that is too slow
    this.slowUntil = 0;
    this.login = { username: config.user || undefined, password: config.password || undefined };
    this.open();
    addEventListener("pagehide", () => this.release());
  }

  // The user at the broker: its access list lets everybody give commands under the own name only.
  get user() {
    return this.login.username || "anyone";
  }

  get client() {
    return `${this.user}/${this.page}`;
  }

  open() {
    this.socket?.end(true);
    const socket = this.socket = mqtt.connect(this.config.websocket, {
      ...this.login, clientId: this.page, clean: true, keepalive: 10, reconnectPeriod: 1000, connectTimeout: 5000,
      queueQoSZero: false, resubscribe: false, timerVariant: "native",
      writeCache: false, // otherwise mqtt.js keeps a buffer for each number up to 65535: 8 MB
    });
    socket.on("connect", () => {
      const mine = `${this.config.topic}/`;
      const names = ["status", "state", "telemetry", "parameters", "methods", "diagnosis", "commissioning", "progress", "event", `reply/${this.client}`];
      this.fresh();
      socket.subscribe(names.map((name) => mine + name), { qos: 1 }, (error) => this.report(error ? "the broker refuses subscriptions" : ""));
    });
    socket.on("close", () => this.report(this.trouble || "no connection to the broker"));
    socket.on("error", (error) => {
      const refused = [4, 5, 134, 135].includes(error.code);
      this.report(refused ? "user or password refused" : "no connection to the broker", refused);
    });
    socket.on("message", (topic, payload) => this.take(topic, payload));
  }

  report(trouble, refused = false) {
    this.trouble = trouble;
    this.connected = !trouble && this.socket.connected;
    if (!this.connected) this.online = false;
    this.handlers.link(this, refused);
  }

  ignore(why) {
    this.ignored[why] += 1;
    this.handlers.ignored(this.ignored);
  }

  take(topic, payload) {
    const name = topic.slice(this.config.topic.length + 1);
    if (payload.length > LARGEST) return this.ignore("huge");
    const words = decoder.decode(payload);
    if (name === "status") {
      this.online = words === "online";
      return this.handlers.link(this, false);
    }
    let message;
    try {
      message = JSON.parse(words);
    } catch {
      return this.ignore("malformed");
    }
    if (!isObject(message)) return this.ignore("malformed");
    if (name === `reply/${this.client}`) return this.answered(message);
    if (!CHECKS[name]?.(message)) return this.ignore("malformed");
    if (name === "telemetry") {
      // A repeated or overtaken batch contains nothing new; after a clock was set back, it does.
      if (message.t0 <= this.latest && message.t0 > this.latest - 5) return this.ignore("reordered");
      this.latest = message.t0;
      this.watch(newest(message));
    }
    this.handlers[name]?.(message);
  }

  fresh() {
    this.usual = Infinity;
    this.late = 0;
    this.catchingUp = false;
  }

  // If the link is too slow for telemetry, telemetry and replies would be delayed more and more. Then it is unsubscribed
  // until the queue is empty, which is when the broker's answer arrives.
  watch(measured) {
    const delay = Date.now() / 1000 - measured;
    this.usual = Math.min(this.usual, delay);
    this.late = delay - this.usual;
    if (performance.now() > this.slowUntil) this.worst = 0;
    this.worst = Math.max(this.worst, this.late);
    if (this.late < LATEST || this.catchingUp) return;
    this.catchingUp = true;
    this.slowUntil = performance.now() + SLOW;
    const topic = `${this.config.topic}/telemetry`;
    this.socket.unsubscribe(topic, () => this.socket.connected && this.socket.subscribe(topic, { qos: 0 }, () => this.fresh()));
  }

  // Commands

  send(verb, args = {}, qos = 1) {
    const id = random();
    this.socket.publish(`${this.config.topic}/cmd/${this.user}/${verb}`,
      JSON.stringify({ id, client: this.page, timestamp: Date.now() / 1000, arguments: args }), { qos });
    return id;
  }

  command(verb, args = {}) {
    if (!this.socket.connected || !this.online) {
      return Promise.resolve({ ok: false, code: "offline", text: "The vehicle cannot be reached.", done: true });
    }
    const id = this.send(verb, args);
    return new Promise((resolve) => {
      const timer = setTimeout(() => {
        this.waiting.delete(id);
        resolve({ ok: false, code: "silent", text: "No answer: are commands enabled, and is this user allowed to send them?", done: true });
      }, PATIENCE);
      this.waiting.set(id, { resolve, timer });
    });
  }

  // The lease of an experiment is held from its request on; `done` is called with the last reply.
  async experiment(name, done) {
    if (this.held) return { ok: false, code: "held", text: "This page already holds an experiment.", done: true };
    const renewing = setInterval(() => this.socket.connected && this.send("renew", {}, 0), RENEWAL);
    const request = this.command("experiment", { name });
    this.held = { done: (reply) => { clearInterval(renewing); this.held = null; done(reply); }, id: null, renewing };
    const first = await request;
    if (!this.held) return first;
    if (!first.ok || first.done) {
      clearInterval(renewing);
      this.held = null;
    } else {
      this.held.id = first.id;
    }
    return first;
  }

  release() {
    if (this.held && this.socket.connected) this.send("release", {}, 0);
  }

  answered(reply) {
    if (!isText(reply.id) || typeof reply.ok !== "boolean" || !isText(reply.text)) return this.ignore("malformed");
    const waiting = this.waiting.get(reply.id);
    if (waiting) {
      clearTimeout(waiting.timer);
      this.waiting.delete(reply.id);
      waiting.resolve(reply);
    } else if (this.held?.id && reply.id === this.held.id && reply.done) {
      this.held.done(reply);
    } else if (this.held?.id && reply.code === "no_lease") {
      clearInterval(this.held.renewing); // latched: it cannot be renewed any more
      setTimeout(() => this.held?.done({ ok: false, code: "lost", text: reply.text, done: true }), 4 * PATIENCE);
    }
  }
}
