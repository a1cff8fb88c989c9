// node lichtblick.js URL TOPIC...   Connects as Lichtblick does, by its libraries, and prints a line of JSON for each message.
//
// The first line is what the server says of itself, with the subprotocol that was agreed on. Numbers are texts, so that
// NaN and every digit arrive.
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { parse } = require("@lichtblick/rosmsg");
const { MessageReader } = require("@lichtblick/rosmsg2-serialization");
const WebSocket = require("ws");

const [url, ...wanted] = process.argv.slice(2);
const SUBPROTOCOLS = [FoxgloveClient.SUPPORTED_SUBPROTOCOL, "foxglove.sdk.v1"]; // as FoxgloveWebSocketPlayer offers them

function text(key, value) {
  return typeof value === "bigint" || typeof value === "number" ? String(value) : value;
}

function print(document) {
  process.stdout.write(`${JSON.stringify(document, text)}\n`);
}

const socket = new WebSocket(url, SUBPROTOCOLS);
const client = new FoxgloveClient({ ws: socket });
const channels = new Map();

client.on("error", (error) => {
  console.error(error.message);
  process.exit(1);
});
client.on("close", () => process.exit(0));
client.on("serverInfo", (info) => print({ ...info, protocol: socket.protocol }));
client.on("status", (status) => print({ status: status.message }));
client.on("advertise", (advertised) => {
  for (const channel of advertised) {
    if (!wanted.includes(channel.topic)) continue;
    const reader = channel.encoding === "cdr" ? new MessageReader(parse(channel.schema, { ros2: true })) : undefined;
    channels.set(client.subscribe(channel.id), { topic: channel.topic, reader });
  }
  print({ subscribed: [...channels.values()].map((each) => each.topic) });
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { topic, reader } = channels.get(subscriptionId);
  const content = reader ? reader.readMessage(data) : Buffer.from(data.buffer, data.byteOffset, data.byteLength).toString("base64");
  print({ topic, timestamp, content });
});
