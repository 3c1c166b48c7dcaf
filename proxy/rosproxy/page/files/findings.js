// What is wrong, one entry for each cause, and what happened: pure functions, without a DOM.

import { duration, isKnown, labelOf, placeOf, RANK } from "./view.js";

const MOST_EVENTS = 50;
const MOST_PLACES = 8; // with an entry of their own in a look
const MOST_GONE = 200;
const SETTLED = 10000; // a proxy first asks all nodes, and until then the document lacks nodes outside
const PROGRAMS = "conntrack|docker|helm|ip|kubectl|nc|ros2|roscore|rosnode|rosparam|rosproxy|rosproxy-operator|rostopic|ss|sudo|sysctl";
// A quoted name, which a node may have chosen, or a program where a fix names a command.
const START = new RegExp(`(?<!\\w)'[^']*'|"[^"]*"|(?<=^|[:;(] ?|(?<!not )\\b(?:[Rr]un|[Rr]ead|[Ss]ee|[Tt]hen|or|with) )(?:${PROGRAMS})(?= )`, "g");
const WORD = /(?:(?<!\w)'[^']*'|"[^"]*"|[^\s'";()])+/y;
// The first words of a sentence after a command.
const STOPS = new Set("and as does fails for from has if in is lists of on or shows tells the then there to where with without".split(" "));
const PLAIN_KINDS = new Set(["node", "participant", "zenoh node"]);

// The causes, the worst first. What has one fix and one place (a container or a machine) is one
// cause: a container that ends, or a firewall, leaves many links with a problem. Names of nodes and
// numbers, such as ports, make no other fix. Pods behind two proxies may have the same name.
// `since`: the time in milliseconds since which the oldest of these problems is there, by the clock
// of the browser, which is `clock` seconds behind the proxy's; Infinity if it is not known. `older`:
// this problem may be older.
export function causesOf({ nodes, links, findings }, clock = 0) {
  const causes = new Map();
  const add = (kind, { place, proxy = "", container = "" }, { what, text, fix, since, older = false }, ids, names = []) => {
    const shape = names.reduce((rest, name) => rest.replaceAll(name, ""), fix || text).replace(/\d+/g, "");
    const key = `f:${JSON.stringify([kind, proxy, place, shape])}`;
    if (!causes.has(key)) causes.set(key, { key, kind, place, container, what, text, fix, count: 0, since: Infinity, older: false, nodes: new Set(), links: new Set() });
    const cause = causes.get(key);
    cause.count += 1;
    const begin = isKnown(since) ? 1000 * (since - clock) : Infinity;
    if (begin < cause.since) Object.assign(cause, { since: begin, older });
    if (ids.node) cause.nodes.add(ids.node);
    if (ids.link) cause.links.add(ids.link);
  };
  for (const one of findings) {
    add(one.severity === "error" ? "broken" : "warning", { place: subjectPlace(one.subject) }, { what: one.subject, text: one.text, fix: one.fix, since: one.wrong_since, older: one.may_be_older }, {});
  }
  for (const [id, node] of nodes) {
    if (isWrong(node)) add(node.state, whereOf(node), { what: labelOf(id, node) + behind([node]), text: node.text || "", fix: node.fix || "", since: node.wrong_since, older: node.may_be_older }, { node: id }, [id, labelOf(id, node)]);
  }
  for (const [id, link] of links) {
    if (!isWrong(link)) continue;
    const ends = [link.source, link.target].filter(Boolean);
    const labels = ends.map((end) => labelOf(end, nodes.get(end)));
    const what = `${link.name} from ${labels.join(" to ")}${behind(ends.map((end) => nodes.get(end)))}`;
    add(link.state, whereOf(nodeOf(link, ends, nodes)), { what, text: link.text || "", fix: link.fix || "", since: link.wrong_since, older: link.may_be_older }, { link: id }, [...ends, ...labels]);
  }
  return [...causes.values()].sort((a, b) => RANK[b.kind] - RANK[a.kind] || b.count - a.count);
}

// The container or pod in the subject of an operator's finding, such as "container talker".
function subjectPlace(subject) {
  const [kind, name] = subject.split(" ");
  return (kind === "container" || kind === "pod") && name || "";
}

function isWrong({ state }) {
  return state === "broken" || state === "warning";
}

// The proxy of the node inside, on an operator's page: two robots may have nodes with the same names.
function behind(ends) {
  const inside = ends.find((one) => one?.proxy);
  return inside ? `, behind ${inside.proxy}` : "";
}

function whereOf(node = {}) {
  return { place: placeOf(node), proxy: node.proxy, container: node.place };
}

// The end of a link that has the same problem, else the end inside.
function nodeOf(link, ends, nodes) {
  const known = ends.map((end) => nodes.get(end)).filter(Boolean);
  return known.find((one) => one.state === link.state && one.fix === link.fix)
    || known.find((one) => one.lane === "container") || known[0];
}

// In words. `seconds`: since which the problem of a cause is there.
export function ageOf({ older }, seconds) {
  if (!older) return `first seen ${duration(seconds)} ago`;
  return seconds < 60 ? "age not known" : `at least ${duration(seconds)} old`;
}

// The parts of a fix, each with whether the part is a command for a shell. Nothing marks a command in a
// fix: it begins with a known program, and ends at the end of the clause.
export function partsOf(fix) {
  const parts = [];
  let end = 0;
  const add = (text, isCommand) => { if (text) parts.push([text, isCommand]); };
  for (const { 0: found, index } of fix.matchAll(START)) {
    const command = /^['"]/.test(found) || index < end ? "" : commandAt(fix, index);
    if (!command.includes(" ")) continue;
    add(fix.slice(end, index), false);
    add(command, true);
    end = index + command.length;
  }
  add(fix.slice(end), false);
  return parts;
}

function commandAt(fix, start) {
  let end = start;
  for (let at = start, isLast = false; !isLast; at += 1) {
    WORD.lastIndex = at;
    const word = WORD.exec(fix)?.[0] || "";
    const bare = word.replace(/[.,:]+$/, "");
    if (!bare || STOPS.has(bare)) break;
    end = at + bare.length;
    at += word.length;
    isLast = bare !== word || fix[at] !== " ";
  }
  return fix.slice(start, end);
}

export function titleOf({ what, count, place, container }) {
  if (count > 1) return `${count}${place ? ` at ${place}` : " times"}: ${what}, …`;
  return container ? `${what}, in ${container}` : what;
}

// Note which causes are new and which are over. `seen`: the causes by their keys, with the time of
// their beginning in milliseconds. Returns the events, the newest first.
export function follow(seen, causes, events, now, isFirst) {
  const found = [];
  const present = new Set(causes.map(({ key }) => key));
  for (const [key, { cause, since }] of seen) {
    if (present.has(key)) continue;
    seen.delete(key);
    found.push({ at: now, over: true, kind: cause.kind, title: titleOf(cause), since, older: cause.older });
  }
  for (const cause of causes) {
    const since = Number.isFinite(cause.since) ? cause.since : seen.get(cause.key)?.since ?? now;
    if (!seen.has(cause.key) && !isFirst) found.push({ at: now, over: false, kind: cause.kind, title: titleOf(cause), since });
    seen.set(cause.key, { cause, since });
  }
  return [...found, ...events].slice(0, MOST_EVENTS);
}

// What a page remembers of nodes and proxies from one look to the next. `known`: the nodes of the
// last look, none before the page has settled. `answering`: the names of proxies. `gone`: the proxies
// that answer no more, with the time. Times are in milliseconds.
export function emptyMemory() {
  return { known: null, answering: null, gone: new Map(), settled: Infinity };
}

// After a new connection, the first documents may lack proxies and nodes.
export function connect(memory, now) {
  memory.answering = null;
  memory.settled = now + SETTLED;
}

// Note which nodes came and went, and which proxies are back. Returns the events, the newest first.
export function followNodes(memory, { nodes, left_out }, events, now) {
  const found = followProxies(memory, nodes, now);
  if (now >= memory.settled && nodes.size) {
    const current = new Map([...nodes].map(([id, node]) => [idOf(id, node), { ...node, label: labelOf(id, node) }]));
    if (memory.known && !left_out) found.push(...changesOf(memory.known, current, silentOf(nodes), now));
    memory.known = left_out ? null : current; // a node that is left out did not go
  }
  return [...found, ...events].slice(0, MOST_EVENTS);
}

// A proxy without an answer has another key than the same proxy with an answer.
function idOf(id, node) {
  return node.kind === "proxy" ? `proxy ${labelOf(id, node)}` : id;
}

function silentOf(nodes) {
  const proxies = [...nodes].filter(([, node]) => node.kind === "proxy");
  return new Set(proxies.filter((one) => !answers(one)).map(([id, node]) => labelOf(id, node)));
}

// On the page of an operator, only a proxy without a document has its name as the key.
function answers([id, node]) {
  return node.state !== "broken" || id !== labelOf(id, node);
}

function followProxies(memory, nodes, now) {
  const { answering: before, gone } = memory;
  const proxies = [...nodes].filter(([, node]) => node.kind === "proxy");
  const after = memory.answering = new Set(proxies.filter(answers).map(([id, node]) => labelOf(id, node)));
  if (!before) return [];
  const lost = [...before].filter((name) => !after.has(name));
  const fresh = [...after].filter((name) => !before.has(name));
  const back = fresh.filter((name) => gone.has(name)).map((name) => ({ at: now,
    title: `proxy ${name}: gone for ${duration((now - gone.get(name)) / 1000)} and back (replaced, restarted or not reachable)` }));
  for (const name of fresh) gone.delete(name);
  for (const name of lost) gone.set(name, now);
  for (const name of [...gone.keys()].slice(0, Math.max(0, gone.size - MOST_GONE))) gone.delete(name);
  // The nodes of these proxies come and go with their documents.
  if (lost.length || fresh.length) memory.settled = Math.max(memory.settled, now + SETTLED);
  return back;
}

// The events of a look. While a proxy does not answer, its nodes and nodes outside are not known to
// be gone, and stay in `current`. A node that is outside for one proxy and then inside did not move.
function changesOf(known, current, silent, now) {
  const isHidden = (node) => silent.has(node.proxy) || (silent.size > 0 && node.lane !== "container");
  const came = [...current].filter(([id]) => !known.has(id)).map(([, node]) => node);
  const went = [];
  for (const [id, node] of known) {
    if (current.has(id)) continue;
    if (isHidden(node)) current.set(id, node);
    else went.push(node);
  }
  const places = new Map();
  const add = (verb, nodes, others) => {
    const lanes = new Map(others.map(({ label, lane }) => [label, lane]));
    for (const node of nodes) {
      if (lanes.has(node.label) && lanes.get(node.label) !== node.lane) continue;
      const key = JSON.stringify([node.proxy, placeOf(node), node.lane]);
      if (!places.has(key)) places.set(key, { node, came: [], went: [] });
      places.get(key)[verb].push(node);
    }
  };
  add("came", came, went);
  add("went", went, came);
  return titlesOf([...places.values()]).map((title) => ({ at: now, title }));
}

function titlesOf(places) {
  if (places.length > MOST_PLACES) {
    const [came, went] = ["came", "went"].map((verb) => places.reduce((sum, place) => sum + place[verb].length, 0));
    const parts = [came && `${came} nodes came`, went && `${went} nodes went`].filter(Boolean);
    return [`${parts.join(", ")} at ${places.length} machines or containers`];
  }
  return places.map(({ node, came, went }) => {
    const parts = [verbOf(came, "came"), verbOf(went, "went")].filter(Boolean);
    return `${parts.join(", ")}${placeOf(node) ? ` at ${placeOf(node)}` : ""}${behind([node])}`;
  });
}

function verbOf(nodes, verb) {
  if (!nodes.length) return "";
  const [{ kind = "node", label }] = nodes;
  const name = PLAIN_KINDS.has(kind) || kind === label ? label : `${kind} ${label}`;
  return nodes.length > 1 ? `${nodes.length} nodes ${verb} (${name}, …)` : `${name} ${verb}`;
}
