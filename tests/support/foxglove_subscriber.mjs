// Clients of Foxglove servers that subscribe to each topic as soon as it is offered, by @foxglove/ws-protocol.
//
//     node foxglove_subscriber.mjs FOLDER SUBPROTOCOL...
//
// FOLDER has node_modules. Each line of standard input is `URL END COUNT`: connect, subscribe to whatever is offered,
// and leave when the clock shows END (ns) and COUNT messages are there, those of NOT_COUNTED aside, or a minute
// later. Each is answered by a line of JSON: the subprotocol, the messages of each topic, and the errors that the
// library or the server reported.
import { createRequire } from "node:module";
import { createInterface } from "node:readline";

const require = createRequire(`${process.argv[2]}/`);
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const WebSocket = require("ws");
const NOT_COUNTED = ["/diagnostics", "/edoras/link_statistics"];

function visit(url, end, wanted) {
  const socket = new WebSocket(url, process.argv.slice(3));
  const client = new FoxgloveClient({ ws: socket });
  const topics = new Map();
  const messages = {};
  const errors = [];
  let count = 0;
  let over = false;
  const leave = () => over && count >= wanted && client.close();
  client.on("error", (error) => errors.push(String(error)));
  client.on("status", (status) => errors.push(status.message));
  client.on("advertise", (channels) => {
    for (const channel of channels) topics.set(client.subscribe(channel.id), channel.topic);
  });
  client.on("message", ({ subscriptionId }) => {
    const topic = topics.get(subscriptionId);
    messages[topic] = (messages[topic] ?? 0) + 1;
    count += !NOT_COUNTED.includes(topic);
    leave();
  });
  client.on("time", ({ timestamp }) => {
    if (!over && timestamp >= end) setTimeout(() => client.close(), 60000).unref();
    over ||= timestamp >= end;
    leave();
  });
  client.on("close", () => console.log(JSON.stringify({ url, protocol: socket.protocol, messages, errors })));
}

for await (const line of createInterface({ input: process.stdin })) {
  const [url, end, wanted] = line.split(" ");
  visit(url, BigInt(end), Number(wanted));
}
