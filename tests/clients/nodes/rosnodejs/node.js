// Small rosnodejs nodes, one for each role:
//     node node.js ROLE [--option value]... [__name:=NAME]
// The arguments and the printed lines are those of the rospy and roscpp nodes.

"use strict";

const { once } = require("node:events");
const { setTimeout: sleep } = require("node:timers/promises");
const { gzipSync } = require("node:zlib");
const rosnodejs = require("rosnodejs");

const ALPHABET = "abcdefghijklmnopqrstuvwxyz";
const MESSAGE = "std_msgs/String";
const SERVICE = "topic_tools/MuxSelect";

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
  if (!(value instanceof Object)) return JSON.stringify(value);
  const keys = Object.keys(value).sort();
  return `{${keys.map((key) => `${JSON.stringify(key)}: ${json(value[key])}`).join(", ")}}`;
}

/** Never resolves: SIGINT, SIGTERM or the slave API's shutdown end the process. */
function spin() {
  return new Promise(() => {});
}

async function publish(node, { topic, word = "hello", rate = 20, size = 0, count = 1e9 }) {
  const publisher = node.advertise(topic, MESSAGE, { queueSize: 10 });
  await once(publisher, "registered");
  say("ready");
  for (let number = 0; number < count && rosnodejs.ok(); number++) {
    const data = payload(word, number, size);
    publisher.publish({ data });
    say("sent", describe(data));
    await sleep(1000 / rate);
  }
  await spin();
}

async function subscribe(node, { topic }) {
  const got = ({ data }) => say("got", describe(data));
  // A negative throttle hands over every message; the default keeps only the latest.
  const subscriber = node.subscribe(topic, MESSAGE, got, { throttleMs: -1 });
  await once(subscriber, "registered");
  say("ready");
  await spin();
}

async function serve(node, { service }) {
  const server = node.advertiseService(service, SERVICE, (request, response) => {
    say("request", describe(request.topic));
    response.prev_topic = "echo " + request.topic;
    return true;
  });
  await once(server, "registered");
  say("ready");
  await spin();
}

async function call(node, options) {
  const { service, persistent = 0, count = 1, rate = 20, size = 0, patience = 30 } = options;
  const newClient = () => node.serviceClient(service, SERVICE, { persist: persistent > 0 });
  say("waiting");
  const found = await node.waitForService(service, patience * 1000);
  if (!found) throw new Error(`no service ${service}`);
  let client = newClient();
  for (let number = 0; number < count && rosnodejs.ok(); number++) {
    try {
      const reply = await client.call({ topic: payload("ask", number, size) });
      say("reply", describe(reply.prev_topic.replace(/^echo /, "")));
    } catch (error) {
      say("failed", number, error.message);
      client = newClient();
    }
    await sleep(1000 / rate);
  }
  say("done");
}

async function setParameter(node, options) {
  await node.setParam(options.key, JSON.parse(options.json));
  say("done");
}

async function getParameter(node, { key }) {
  say("value", json(await node.getParam(key)));
}

const ROLES = {
  pub: publish,
  sub: subscribe,
  serve,
  call,
  setparam: setParameter,
  getparam: getParameter,
};

async function main() {
  const [role, ...words] = process.argv.slice(2).filter((word) => !word.includes(":="));
  // With forceExit the library's own handler of SIGINT unregisters and ends the process.
  process.once("SIGTERM", () => process.emit("SIGINT"));
  const node = await rosnodejs.initNode("node", {
    onTheFly: true,
    node: { forceExit: true },
    logging: { level: "warn" }, // what is below goes to standard output
  });
  say("node", node.getNodeName());
  await ROLES[role](node, readOptions(words));
}

main()
  .catch((error) => {
    console.error(error);
    process.exitCode = 1;
  })
  .finally(async () => {
    await rosnodejs.shutdown();
    process.exit();
  });
