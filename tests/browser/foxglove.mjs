// Reads a node, or plays a recording, over the WebSocket server for Foxglove, with Foxglove's own npm client.
//
//     node foxglove.mjs live ws://127.0.0.1:PORT
//     node foxglove.mjs playback ws://127.0.0.1:PORT
//
// Prints one line of JSON. The npm client predates playback control, so its two messages are encoded and decoded here,
// after the protocol's specification.

import protocol from "@foxglove/ws-protocol";
import WebSocket from "ws";

const { FoxgloveClient } = protocol;
const [mode, url] = process.argv.slice(2);
const PATIENCE_MS = 30_000;
/** Opcodes of playback control. */
const CONTROL = 3;
const STATE = 5;
const STATUSES = ["playing", "paused", "buffering", "ended"];

const ws = new WebSocket(url, ["foxglove.sdk.v1"]);
ws.binaryType = "arraybuffer";
const client = new FoxgloveClient({ ws });
const seen = { topics: {}, channels: [], info: null, parameters: {}, statuses: [], states: [], errors: [], times: [] };
const byId = new Map();
let messages = [];

ws.addEventListener("message", ({ data }) => {
  if (typeof data === "string" || new DataView(data).getUint8(0) !== STATE) return;
  const view = new DataView(data);
  const length = view.getUint32(15, true);
  seen.states.push({
    status: STATUSES[view.getUint8(1)],
    at: view.getBigUint64(2, true),
    speed: view.getFloat32(10, true),
    sought: view.getUint8(14) === 1,
    id: new TextDecoder().decode(new Uint8Array(data, 19, length)),
  });
});
// Those of the playback states, which the client does not know.
client.on("error", (error) => seen.errors.push(String(error)));
client.on("serverInfo", (info) => (seen.info = info));
client.on("status", ({ message }) => seen.statuses.push(message));
client.on("time", ({ timestamp }) => seen.times.push(timestamp));
client.on("parameterValues", ({ parameters }) => parameters.forEach(({ name, value }) => (seen.parameters[name] = value)));
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { topic } = byId.get(subscriptionId);
  seen.topics[topic] = (seen.topics[topic] ?? 0) + 1;
  messages.push({ topic, timestamp, bytes: data.byteLength });
});
client.on("advertise", (channels) => {
  for (const channel of channels) {
    seen.channels.push(channel);
    byId.set(client.subscribe(channel.id), channel);
  }
});

async function until(what, holds) {
  const deadline = Date.now() + PATIENCE_MS;
  while (!holds()) {
    if (Date.now() > deadline) throw new Error(`waited too long for ${what}: ${show(seen)}`);
    await pause(10);
  }
}

const pause = (ms) => new Promise((done) => setTimeout(done, ms));
const show = (value) => JSON.stringify(value, (_, inner) => (typeof inner === "bigint" ? inner.toString() : inner));

/** Asks for a state of the player and waits for its answer. */
async function control(play, speed, seek) {
  const id = `request ${seen.states.length}`;
  const name = new TextEncoder().encode(id);
  const bytes = new Uint8Array(19 + name.length);
  const view = new DataView(bytes.buffer);
  view.setUint8(0, CONTROL);
  view.setUint8(1, play ? 0 : 1);
  view.setFloat32(2, speed, true);
  view.setUint8(6, seek === undefined ? 0 : 1);
  view.setBigUint64(7, seek ?? 0n, true);
  view.setUint32(15, name.length, true);
  bytes.set(name, 19);
  ws.send(bytes);
  await until(id, () => seen.states.some((state) => state.id === id));
  return seen.states.find((state) => state.id === id);
}

async function live() {
  await until("messages", () => seen.topics["/squealcast/prediction"] > 20 && seen.topics["/diagnostics"] > 0 && seen.topics["/squealcast/rig"] > 0);
  client.getParameters([], "all");
  await until("parameters", () => seen.parameters.warn_margin !== undefined);
  const before = seen.parameters.warn_margin;
  client.subscribeParameterUpdates(["warn_margin"]);
  client.setParameters([{ name: "warn_margin", value: 0.125, type: "float64" }], "set");
  await until("the new value", () => seen.parameters.warn_margin === 0.125);
  client.setParameters([{ name: "warn_margin", value: -1, type: "float64" }], "refused");
  await until("a refusal", () => seen.statuses.length > 0);
  client.getParameters(["warn_margin"], "again");
  await pause(500);
  const schemas = Object.fromEntries(seen.channels.map(({ topic, encoding, schemaName, schemaEncoding, schema }) => [topic, { encoding, schemaName, schemaEncoding, lines: schema.split("\n").length }]));
  return { before, parameters: seen.parameters, statuses: seen.statuses, topics: seen.topics, schemas, capabilities: seen.info.capabilities };
}

async function playback() {
  await until("the server", () => seen.info && seen.channels.length > 0);
  const paused = await control(false, 1);
  await pause(200);
  const [begin, end] = [seen.info.dataStartTime, seen.info.dataEndTime].map(({ sec, nsec }) => BigInt(sec) * 1_000_000_000n + BigInt(nsec));
  messages = [];
  await pause(500);
  const whilePaused = messages.length;
  const middle = begin + (end - begin) / 2n;
  const sought = await control(true, 4, middle);
  await until("the end", () => seen.states.some((state) => state.status === "ended"));
  await pause(200);
  const first = messages.reduce((least, { timestamp }) => (timestamp < least ? timestamp : least), end);
  return {
    capabilities: seen.info.capabilities, begin, end, middle, paused, whilePaused, sought,
    first, inputs: messages.filter(({ topic }) => topic === "/rig/operating_point").length, ended: seen.states.at(-1),
    clock: seen.times.at(-1),
  };
}

const report = await { live, playback }[mode]();
console.log(show(report));
ws.close();
