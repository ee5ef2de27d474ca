// Subscribes to every topic with Foxglove's own client and says what came, as JSON.
import { createRequire } from "node:module";
import { join } from "node:path";

const require = createRequire(join(process.env.NODE_MODULES, "index.js"));
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const WebSocket = require("ws");

const [address, protocol, instance] = process.argv.slice(2);
const client = new FoxgloveClient({ ws: new WebSocket(`ws://${address}`, [protocol]) });
const found = { topics: [], counts: {}, afterUnsubscribe: 0 };
const readers = new Map();
const last = {};
const fail = (error) => {
  console.error(error);
  process.exit(1);
};
setTimeout(() => fail(`not all came: ${JSON.stringify(found)}`), 120000);

client.on("error", fail);
client.on("serverInfo", (info) => {
  found.name = info.name;
  found.encodings = info.supportedEncodings;
});
client.on("status", (status) => (found.warning = status.message));
client.on("advertise", (channels) => {
  for (const channel of channels) {
    found.topics.push(channel.topic);
    const reader = new MessageReader(parse(channel.schema, { ros2: true }));
    readers.set(client.subscribe(channel.id), { channel, reader });
  }
  client.subscribe(999);
});

let ended = false;
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { channel, reader } = readers.get(subscriptionId);
  const message = reader.readMessage(data);
  if (ended && channel.topic === `/${instance}/odom`) found.afterUnsubscribe++;
  found.counts[channel.topic] = (found.counts[channel.topic] ?? 0) + 1;
  last[channel.topic] = message;
  if (timestamp === 0n) fail("a message without time");
  const isEnough = found.topics.every((topic) => found.counts[topic] > 0) && found.counts["/tf"] > 10;
  if (isEnough && !ended && found.warning) {
    ended = true;
    for (const [id, { channel }] of readers) {
      if (channel.topic === `/${instance}/odom`) client.unsubscribe(id);
    }
    // What was on its way may still come; then nothing.
    setTimeout(() => (found.afterUnsubscribe = 0), 1000);
    setTimeout(finish, 2000);
  }
});

function finish() {
  const odom = last[`/${instance}/odom`];
  found.odom = [odom.header.frame_id, odom.child_frame_id];
  found.odomSeconds = odom.header.stamp.sec;
  found.cloudPoints = last[`/${instance}/points`].width;
  found.imageFormat = last[`/${instance}/image_rect/compressed`].format;
  found.status = last["/diagnostics"].status[0].name;
  console.log(JSON.stringify(found));
  client.close();
  setTimeout(() => process.exit(0), 200);
}
