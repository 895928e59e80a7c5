// Reads MCAP recordings with Foxglove's own libraries, as its app does.
//
//     node foxglove_reader.mjs FOLDER FILE
//
// FOLDER has node_modules. Each message is a line of JSON: topic, time in ns, values; integers of 64 bits are texts.
import { createRequire } from "node:module";
import { open } from "node:fs/promises";

const require = createRequire(`${process.argv[2]}/`);
const { McapIndexedReader } = require("@mcap/core");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const zstd = require("@foxglove/wasm-zstd");

const file = await open(process.argv[3]);
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, size) => {
    const data = new Uint8Array(Number(size));
    await file.read(data, 0, data.length, Number(offset));
    return data;
  },
};

function plain(_, value) {
  if (typeof value === "bigint") return String(value);
  if (typeof value === "number" && !Number.isFinite(value)) return String(value);
  return ArrayBuffer.isView(value) ? Array.from(value, (item) => plain("", item)) : value;
}

await zstd.isLoaded;
const decompressHandlers = { zstd: (data, size) => zstd.decompress(data, Number(size)) };
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const readers = new Map();
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  if (!readers.has(channel.id)) {
    const schema = reader.schemasById.get(channel.schemaId);
    readers.set(channel.id, new MessageReader(parse(new TextDecoder().decode(schema.data), { ros2: true })));
  }
  const values = readers.get(channel.id).readMessage(message.data);
  console.log(JSON.stringify([channel.topic, String(message.logTime), values], plain));
}
