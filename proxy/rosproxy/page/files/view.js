// What is to be seen of a document: pure functions, without a DOM.
//
// A document has nodes, in three lanes, and links between them; picture.js places them. Nothing here
// is HTML: names are whatever nodes call themselves.

export const RANK = { ok: 0, unknown: 1, warning: 2, broken: 3 };
export const LANES = ["robot", "host", "container"];

export function labelOf(id, node) {
  return (node && node.label) || id;
}

// The first part of a name that has more than one: "/arm" of "/arm/driver"; else nothing.
export function namespaceOf(label) {
  const parts = label.split("/");
  return parts[0] === "" && parts.length > 2 ? `/${parts[1]}` : "";
}

// What a filter finds of a node: names, the host, the container or pod, the domain, and the proxy or
// master in the key.
function wordsOf(id, node = {}) {
  const domain = node.kind === "participant" ? ` domain ${id.split(" ").at(-2)}` : "";
  return [labelOf(id, node), id, hostOf(node.address), node.place, node.detail].filter(Boolean).join(" ") + domain;
}

// The links that are wanted, those that are broken first, then by name.
export function visibleLinks(links, nodes, { quiet, filter }) {
  const wanted = filter.trim().toLowerCase();
  const found = [];
  for (const [id, link] of links) {
    if (link.quiet && !quiet && link.state !== "broken") continue;
    const ids = [link.source, link.target || ""];
    const ends = ids.map((end) => labelOf(end, nodes.get(end)));
    if (wanted && ![link.name, link.type || "", ...ids.map((end) => wordsOf(end, nodes.get(end)))].some((text) => text.toLowerCase().includes(wanted))) continue;
    found.push({ id, link, from: ends[0], to: ends[1] });
  }
  const order = (one) => RANK[one.link.state || "unknown"] >= 2 ? RANK[one.link.state] : 0;
  const key = (one) => `${one.link.kind === "topic" ? 0 : 1} ${one.id}`;
  const keys = new Map(found.map((one) => [one, key(one)]));
  return found.sort((a, b) =>
    order(b) - order(a) || (keys.get(a) < keys.get(b) ? -1 : 1));
}

// The nodes that are wanted, those that are broken first, then by lane and name.
export function visibleNodes(nodes, { quiet, filter }) {
  const wanted = filter.trim().toLowerCase();
  const found = [];
  for (const [id, node] of nodes) {
    const label = labelOf(id, node);
    if (wanted ? !wordsOf(id, node).toLowerCase().includes(wanted) : label === "/rosout" && !quiet) continue;
    const order = RANK[node.state || "ok"] >= 2 ? RANK[node.state] : 0;
    found.push({ id, node: { ...node, state: node.state || "ok" }, label, order, key: `${LANES.indexOf(node.lane)} ${label} ${id}` });
  }
  return found.sort((a, b) => b.order - a.order || (a.key < b.key ? -1 : 1));
}

// Whether messages flow through a link now. "still": none; "uncounted": no program tells. Several
// links of ROS 2 to one participant share its measures: then data may be of any of them.
export function flowOf(link) {
  if (link.flows) return "flows";
  if (link.shared && link.datagrams) return "uncounted";
  return [link.hz, link.rate, link.since].some((one) => one !== undefined && one !== null) ? "still" : "uncounted";
}

// The host in "172.18.0.2:45000", a slave URI, "[fd00::2]:45000" or "10.1.2.3, Fast DDS".
export function hostOf(address = "") {
  const plain = address.split(",")[0].replace(/^\w+:\/\//, "").split("/")[0];
  if (plain.startsWith("[")) return plain.slice(1).split("]")[0];
  const parts = plain.split(":");
  return parts.length === 2 ? parts[0] : plain;
}

// The container or pod of a node if the document has the name, else the host in the address.
export function placeOf(node = {}) {
  return node.place || hostOf(node.address);
}

// Messages per second; of ROS 2 datagrams per second.
export function hertz(link) {
  if (isKnown(link.datagrams)) return `${atMost(link, link.datagrams)}${link.datagrams} datagrams/s`;
  return isKnown(link.hz) ? String(link.hz) : "–";
}

// The same with the unit; empty if it is not known.
export function frequency(link) {
  const text = hertz(link);
  return text === "–" ? "" : isKnown(link.datagrams) ? text : `${text} Hz`;
}

export function megabytes(link) {
  if (!isKnown(link.rate)) return "–";
  const rate = link.rate / 1e6;
  if (rate > 0 && rate < 0.001) return "<0.001";
  return `${atMost(link, rate)}${Number(rate.toPrecision(2))}`;
}

export function isKnown(value) {
  return value !== undefined && value !== null;
}

// The mark of a measure that a link shares: the link alone has as much or less.
function atMost(link, value) {
  return link.shared && value ? "≤ " : "";
}

// The bytes per second of links together; undefined if they are not known. Links that share their
// measures count once. The sum is `shared` with others if any of these links is not in the list.
export function rateOf(links) {
  const groups = new Map();
  let rate;
  for (const link of links.filter((one) => isKnown(one.rate))) {
    const group = `${link.proxy || ""} ${link.target}`;
    const count = groups.get(group) || 0;
    groups.set(group, count + 1);
    if (!link.shared || !count) rate = (rate || 0) + link.rate;
  }
  const shared = links.filter((one) => one.shared > groups.get(`${one.proxy || ""} ${one.target}`)).length;
  return { rate, shared };
}

// `now` is in seconds since the epoch, by the proxy's clock as far as is known.
export function age(link, now) {
  if (link.flows) return link.shared ? "–" : "just now";
  if (!isKnown(link.since)) return "–";
  return `${link.shared ? "at least " : ""}${duration(now - link.since)} ago`;
}

export function duration(exact) {
  const seconds = Math.max(0, Math.round(exact));
  if (seconds < 120) return `${seconds} s`;
  return seconds < 7200 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
}

export const WORDS = { ok: "ok", unknown: "not looked at", warning: "warning", broken: "BROKEN" };

// Apply an event to maps of nodes and links.
export function apply(table, rows) {
  for (const [id, row] of Object.entries(rows || {})) {
    if (row === null) table.delete(id);
    else table.set(id, row);
  }
}
