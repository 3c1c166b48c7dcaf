// Small nodes of @foxglove/ros1, one for each role:
//     node node.js ROLE [--option value]... [__name:=NAME]
// The arguments and the printed lines are those of the rospy and roscpp nodes.
// The library has no services, so there is no `serve` and no `call`.

"use strict";

const { setTimeout: sleep } = require("node:timers/promises");
const { gzipSync } = require("node:zlib");
const { RosNode } = require("@foxglove/ros1");
const ros = require("@foxglove/ros1/nodejs");
const { HttpServerNodejs } = require("@foxglove/xmlrpc/nodejs");

const ALPHABET = "abcdefghijklmnopqrstuvwxyz";
const STRING = { dataType: "std_msgs/String", messageDefinitionText: "string data" };

/** The `--option value` pairs of the command line. */
function readOptions(words) {
  const options = {};
  for (let i = 0; i < words.length; i += 2) options[words[i].replace(/^--/, "")] = words[i + 1];
  return options;
}

function say(...words) {
  process.stdout.write(words.join(" ") + "\n");
}

/** `word number` filled up to `size` characters. */
function payload(word, number, size) {
  const head = `${word} ${number} `;
  const rest = Math.max(0, size - head.length);
  return head + ALPHABET.repeat(rest / ALPHABET.length + 1).slice(0, rest);
}

/** What identifies a payload: its first two words, its size and its checksum. */
function describe(text) {
  const [word, number] = text.split(" ", 2);
  const data = Buffer.from(text);
  const checksum = gzipSync(data).subarray(-8).readUInt32LE(); // a gzip file ends with CRC and size
  const crc = checksum.toString(16).padStart(8, "0");
  return `${word} ${number} size ${data.length} crc ${crc} at ${(Date.now() / 1000).toFixed(3)}`;
}

/** As Python's json.dumps(value, sort_keys=True). */
function json(value) {
  if (Array.isArray(value)) return `[${value.map(json).join(", ")}]`;
  if (!(value instanceof Object)) return JSON.stringify(value ?? null);
  const keys = Object.keys(value).sort();
  return `{${keys.map((key) => `${JSON.stringify(key)}: ${json(value[key])}`).join(", ")}}`;
}

/** The library resolves no names. */
function absolute(name) {
  return name.startsWith("/") ? name : "/" + name;
}

async function publish(node, { topic, word = "hello", rate = 20, size = 0, count = 1e9 }) {
  topic = absolute(topic);
  await node.advertise({ topic, ...STRING });
  say("ready");
  for (let number = 0; number < count && node.isAdvertising(topic); number++) {
    const data = payload(word, number, size);
    node.publish(topic, { data }); // not awaited: one stuck subscriber would hold up the others
    say("sent", describe(data));
    await sleep(1000 / rate);
  }
}

async function subscribe(node, { topic }) {
  const subscription = node.subscribe({ topic: absolute(topic), dataType: STRING.dataType });
  subscription.on("message", ({ data }) => say("got", describe(data)));
  say("ready");
}

async function setParameter(node, options) {
  await node.setParameter(options.key, JSON.parse(options.json));
  say("done");
  node.shutdown();
}

async function getParameter(node, { key }) {
  const [status, message, value] = await node.rosParamClient.getParam(node.name, key);
  if (status !== 1) throw new Error(message);
  say("value", json(value));
  node.shutdown();
}

const ROLES = {
  pub: publish,
  sub: subscribe,
  setparam: setParameter,
  getparam: getParameter,
};

async function main() {
  const isRemapping = (word) => word.includes(":=");
  const words = process.argv.slice(2);
  const [role, ...rest] = words.filter((word) => !isRemapping(word));
  const remappings = Object.fromEntries(words.filter(isRemapping).map((word) => word.split(":=")));
  if (!(role in ROLES)) {
    console.error(`no role ${role}: @foxglove/ros1 has no services`);
    process.exitCode = 2;
    return;
  }

  const node = new RosNode({
    name: absolute(remappings.__name ?? "node"),
    hostname: RosNode.GetRosHostname(ros.getEnvVar, ros.getHostname, ros.getNetworkInterfaces),
    pid: ros.getPid(),
    rosMasterUri: process.env.ROS_MASTER_URI,
    httpServer: new HttpServerNodejs(),
    tcpSocketCreate: ros.TcpSocketNode.Create,
    tcpServer: await ros.TcpServerNode.Listen({}),
    log: { warn: console.warn },
  });
  const shutdown = () => {
    node.shutdown();
    // Its timers for reconnecting, left running, would delay the end by up to ten seconds.
    setTimeout(process.exit, 2000).unref();
  };
  process.once("SIGINT", shutdown);
  process.once("SIGTERM", shutdown);
  await node.start();
  say("node", node.name);
  try {
    await ROLES[role](node, readOptions(rest));
  } catch (error) {
    console.error(error);
    process.exitCode = 1;
    node.shutdown();
  }
}

main();
