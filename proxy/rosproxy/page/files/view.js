// What is to be seen of a document: pure functions, without a DOM.
//
// A document has nodes, in three lanes, and links between them. Nodes of one namespace in one lane
// are one box until it is unfolded; all links between two boxes are one line, in the worst of their
// states. Nothing here is HTML: names are whatever nodes call themselves.

export const RANK = { ok: 0, unknown: 1, warning: 2, broken: 3 };
const LANES = ["robot", "host", "container"];
const WIDE = 420;
const HIGH = 58;

export function labelOf(id, node) {
  return (node && node.label) || id;
}

// The first part of a name that has more than one: "/arm" of "/arm/driver"; else nothing.
export function namespaceOf(label) {
  const parts = label.split("/");
  return parts[0] === "" && parts.length > 2 ? `/${parts[1]}` : "";
}

// The links that are wanted, those that are broken first, then by name.
export function visibleLinks(links, nodes, { quiet, filter }) {
  const wanted = filter.trim().toLowerCase();
  const found = [];
  for (const [id, link] of links) {
    if (link.quiet && !quiet && link.state !== "broken") continue;
    const ends = [link.source, link.target || ""].map((end) => labelOf(end, nodes.get(end)));
    const text = `${link.name} ${ends.join(" ")}`.toLowerCase();
    if (wanted && !text.includes(wanted)) continue;
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
    if (wanted ? !label.toLowerCase().includes(wanted) : label === "/rosout" && !quiet) continue;
    const order = RANK[node.state || "ok"] >= 2 ? RANK[node.state] : 0;
    found.push({ id, node: { ...node, state: node.state || "ok" }, label, order, key: `${LANES.indexOf(node.lane)} ${label} ${id}` });
  }
  return found.sort((a, b) => b.order - a.order || (a.key < b.key ? -1 : 1));
}

// The boxes of nodes: each node's, or that of its folded namespace. `unfolded` has keys of boxes.
export function boxesOf(nodes, shown, { unfoldAll, unfolded }) {
  const members = new Map();
  for (const [id, node] of nodes) {
    if (!shown.has(id)) continue;
    const space = node.kind === "node" || !node.kind ? namespaceOf(labelOf(id, node)) : "";
    const key = space ? `${node.lane} ${node.proxy || ""} ${space}` : "";
    if (!key) continue;
    // Robots often have the same names: of several proxies each box says whose it is.
    const label = node.proxy ? `${space} (${node.proxy})` : space;
    if (!members.has(key)) members.set(key, { label, ids: [] });
    members.get(key).ids.push(id);
  }
  const boxOf = new Map();
  const boxes = new Map();
  for (const id of shown) {
    const node = nodes.get(id);
    if (node) boxOf.set(id, `n:${id}`);
  }
  const folds = [];
  for (const [key, { label, ids }] of members) {
    if (ids.length < 2) continue;
    const open = unfoldAll || unfolded.has(key);
    folds.push({ key, open, label, count: ids.length });
    if (!open) for (const id of ids) boxOf.set(id, `f:${key}`);
  }
  for (const [id, box] of boxOf) {
    const node = nodes.get(id);
    const state = node.state || "ok";
    const known = boxes.get(box);
    if (known) {
      known.count += 1;
      if (RANK[state] > RANK[known.state]) known.state = state;
      continue;
    }
    const fold = box.startsWith("f:") ? box.slice(2) : "";
    const label = fold ? members.get(fold).label : labelOf(id, node);
    boxes.set(box, { id: box, fold, node: id, label, lane: node.lane, state, count: 1,
      kind: node.kind || "node" });
  }
  return { boxOf, boxes, folds };
}

// The lines between boxes, each with its links.
export function linesOf(found, boxOf) {
  const lines = new Map();
  for (const one of found) {
    const from = boxOf.get(one.link.source);
    const to = one.link.target ? boxOf.get(one.link.target) : undefined;
    if (!from || !to || from === to) continue;
    const id = `l:${JSON.stringify([from, to])}`;
    const state = one.link.state || "unknown";
    const line = lines.get(id);
    if (!line) {
      lines.set(id, { id, from, to, state, links: [one], flows: Boolean(one.link.flows) });
    } else {
      line.links.push(one);
      line.flows = line.flows || Boolean(one.link.flows);
      if (RANK[state] > RANK[line.state]) line.state = state;
    }
  }
  return lines;
}

// Where the boxes stand: by lane and name; the first row is for what is no node.
export function positions(boxes) {
  const lanes = new Map(LANES.map((lane) => [lane, []]));
  for (const box of boxes.values()) (lanes.get(box.lane) || lanes.get("robot")).push(box);
  const found = new Map();
  LANES.forEach((lane, column) => {
    const own = lanes.get(lane).sort((a, b) =>
      isNode(a) - isNode(b) || (a.label < b.label ? -1 : 1));
    const per = Math.max(12, Math.ceil(Math.sqrt(own.length * 4)));
    own.forEach((box, index) => {
      const inner = Math.floor(index / per);
      found.set(box.id, {
        x: column * WIDE * Math.max(1, Math.ceil(boxes.size / 60)) + inner * 190,
        y: (index % per + (isNode(own[0]) ? 1 : 0)) * HIGH,
      });
    });
  });
  return found;
}

function isNode(box) {
  return box.kind === "node" || box.kind === "participant";
}

export function hertz(link) {
  return link.hz === undefined || link.hz === null ? "–" : String(link.hz);
}

export function megabytes(link) {
  if (link.rate === undefined || link.rate === null) return "–";
  const rate = link.rate / 1e6;
  return rate === 0 ? "0" : rate < 0.001 ? "<0.001" : String(Number(rate.toPrecision(2)));
}

// `now` is in seconds since the epoch, by the proxy's clock as far as is known.
export function age(link, now) {
  if (link.flows) return "just now";
  if (link.since === undefined || link.since === null) return "–";
  const seconds = Math.max(0, Math.round(now - link.since));
  if (seconds < 120) return `${seconds} s ago`;
  return seconds < 7200 ? `${Math.round(seconds / 60)} min ago` : `${Math.round(seconds / 3600)} h ago`;
}

export const WORDS = { ok: "ok", unknown: "not looked at", warning: "warning", broken: "BROKEN" };

// Apply an event to maps of nodes and links.
export function apply(table, rows) {
  for (const [id, row] of Object.entries(rows || {})) {
    if (row === null) table.delete(id);
    else table.set(id, row);
  }
}
