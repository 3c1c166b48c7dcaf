// The graph as groups, lines and places: pure functions, without a DOM.
//
// Three lanes stand side by side: outside, host, inside. Nodes of one place (a machine, a container
// or a pod) are a group, and nodes of one namespace a group in this group. A folded group is one
// box. All links between two boxes through the same proxy are one line. A line leaves its box into
// the free channel between two lanes, passes the middle lane in a row of its own, and enters the
// other channel: so no line runs through a box, and no two labels overlap.

import { flowOf, hostOf, labelOf, LANES, namespaceOf, RANK } from "./view.js";

export const DIRECT = ""; // the key of no proxy
const MOST_ROWS = 30; // of a lane that unfolds by itself
const FEW_ROWS = 24; // of a lane that unfolds again: so a node that comes and goes turns no group
const MOST_PLACES = 24;
const MOST_LINES = 60;
const LEAST_WIDTH = 600;
const NARROW = 900; // a row of a narrower picture has two lines of text
const BOX = 26;
const ROW = 22;
const FIX = 16; // a second line of text in a row
const GAP = 4;
const PAD = 8;
const INDENT = 14;

// Groups

// The boxes of each lane from top to bottom, the box that shows each node, and the depths to which
// groups are unfolded by lane, for the next time.
export function boxesOf(nodes, shown, chosen) {
  const boxOf = new Map();
  const depths = {};
  const lanes = LANES.map((lane) => {
    const found = [...shown].filter((id) => nodes.has(id) && laneOf(nodes.get(id)) === lane && nodes.get(id).kind !== "proxy");
    const places = placesOf(lane, found, nodes);
    const most = depthThatFits(places, MOST_ROWS);
    const former = Math.min(most, chosen.depths[lane] ?? most);
    depths[lane] = Math.max(former, depthThatFits(places, FEW_ROWS));
    const depth = chosen.unfoldAll ? Infinity : depths[lane];
    const boxes = [];
    for (const place of places) addBoxes(place, 0, { boxes, boxOf, nodes, depth, turned: chosen.turned, place: place.key, owner: place.note });
    return boxes;
  });
  return { lanes, boxOf, depths };
}

function laneOf(node) {
  return LANES.includes(node.lane) ? node.lane : LANES[0];
}

// The places of a lane as trees; of very many, the last ones are in one group.
function placesOf(lane, ids, nodes) {
  const byKey = new Map();
  for (const id of ids) {
    const node = nodes.get(id);
    const host = hostOf(node.address);
    const key = `${lane} ${node.proxy || ""} ${host}`;
    if (!byKey.has(key)) byKey.set(key, { key, label: node.place || host, note: node.proxy || "", ids: [] });
    byKey.get(key).ids.push(id);
  }
  const places = [...byKey.values()].sort((a, b) => compare(a.key, b.key));
  for (const place of places) place.children = childrenOf(place, nodes);
  const owners = new Set(places.map((place) => place.note));
  if (places.length <= MOST_PLACES) return places;
  const most = Math.max(1, Math.floor(MOST_PLACES / owners.size) - 1);
  return [...owners].flatMap((owner) => shortened(lane, owner, places.filter((place) => place.note === owner), nodes, most));
}

// As many places as are shown, those with a problem first, and a group of the others.
function shortened(lane, owner, places, nodes, most) {
  const rank = new Map(places.map((place) => [place, Math.max(1, worst(place.ids, nodes))]));
  const first = new Set([...places].sort((p, q) => rank.get(q) - rank.get(p)).slice(0, most));
  const rest = places.filter((place) => !first.has(place));
  if (rest.length < 2) return places;
  const label = `${rest.length} more ${lane === "container" ? "containers" : "machines"}`;
  const more = { key: `${lane} ${owner} more`, label, note: owner, ids: rest.flatMap((place) => place.ids), children: rest };
  return [...places.filter((place) => first.has(place)), more];
}

// The namespaces of a place that have several nodes, and its other nodes.
function childrenOf(place, nodes) {
  const spaces = new Map();
  for (const id of place.ids) {
    const space = namespaceOf(labelOf(id, nodes.get(id)));
    const key = space ? `${place.key} ${space}` : `n:${id}`;
    if (!spaces.has(key)) spaces.set(key, { key, label: space, note: "", ids: [] });
    spaces.get(key).ids.push(id);
  }
  const children = [...spaces.values()].map((space) => {
    if (space.ids.length === 1 || spaces.size === 1) return space.ids.map((id) => leafOf(id, nodes));
    return [{ ...space, children: space.ids.map((id) => leafOf(id, nodes)).sort((a, b) => compare(a.label, b.label)) }];
  });
  return children.flat().sort((a, b) => compare(a.label, b.label));
}

function leafOf(id, nodes) {
  return { key: `n:${id}`, label: labelOf(id, nodes.get(id)), note: "", ids: [id], node: id };
}

// How many levels of groups unfold by themselves: as many as stay readable.
function depthThatFits(places, most) {
  let level = places;
  let rows = places.length;
  for (let depth = 0; ; depth += 1) {
    const groups = level.filter((one) => one.children && one.ids.length > 1);
    if (!groups.length) return Infinity;
    level = groups.flatMap((one) => one.children);
    rows += level.length;
    if (rows > most) return depth;
  }
}

function addBoxes(tree, level, found) {
  const { boxes, boxOf, nodes, depth, turned, place, owner } = found;
  const alone = tree.ids.length === 1;
  const one = alone ? leafOf(tree.ids[0], nodes) : tree;
  const open = !alone && Boolean(tree.children) && (turned.has(tree.key) ? turned.get(tree.key) : level < depth);
  const node = alone ? nodes.get(one.node) : {};
  const wrong = one.ids.filter((id) => RANK[nodes.get(id).state || "ok"] >= 2).length;
  const rank = worst(one.ids, nodes);
  boxes.push({ id: alone ? one.key : `g:${tree.key}`, key: alone ? "" : tree.key, label: one.label || "address not known",
    note: alone ? placeNote(tree, one.label) : groupNote(tree, wrong), level, place, owner, open,
    ids: one.ids, kind: alone ? node.kind || "node" : "group", state: Object.keys(RANK).find((state) => RANK[state] === rank) });
  for (const id of one.ids) boxOf.set(id, boxes.at(-1).id);
  if (open) for (const child of tree.children) addBoxes(child, level + 1, found);
}

// Of a place with a single node, which has no box of its own. The node may have the place's name.
function placeNote(place, label) {
  const name = place.label === label ? "" : place.label;
  return place.children ? [name, place.note && `of ${place.note}`].filter(Boolean).join(" ") : "";
}

function groupNote(group, wrong) {
  const parts = [`${group.ids.length} nodes`, wrong ? `${wrong} wrong` : "", group.note && `of ${group.note}`];
  return parts.filter(Boolean).join(", ");
}

function worst(ids, nodes) {
  return Math.max(...ids.map((id) => RANK[nodes.get(id).state || "ok"]));
}

// Lines

// The links, each with the line that shows it: its boxes, and the proxy that it passes.
export function joined(found, lanes, boxOf, proxies) {
  const order = new Map(lanes.flat().map((box, index) => [box.id, index]));
  const only = proxies.size === 1 ? [...proxies.keys()][0] : "";
  return found.map((one) => {
    const ends = [boxOf.get(one.link.source), boxOf.get(one.link.target)];
    if (!ends[0] || !ends[1] || ends[0] === ends[1]) return { ...one, line: "" };
    const turned = order.get(ends[0]) > order.get(ends[1]);
    const [a, b] = turned ? [ends[1], ends[0]] : ends;
    const proxy = one.link.proxy || only;
    const via = one.link.port && proxies.has(proxy) ? proxy : DIRECT;
    return { ...one, a, b, via, turned, line: `l:${JSON.stringify([a, b, via])}` };
  });
}

// What is chosen: nodes, links, and the nodes at the ends of these links. `key`: "n:" and a node,
// "k:" and a link, or the id of a box, a line or a `cause`.
export function selection(key, links, boxes, cause) {
  const named = key.startsWith("n:") ? [key.slice(2)] : [];
  const nodes = new Set(cause ? cause.nodes : boxes.has(key) ? boxes.get(key).ids : named);
  const isChosen = ({ id, link, line, via }) => cause ? cause.links.has(id) :
    line === key || `k:${id}` === key || `n:${via}` === key || nodes.has(link.source) || nodes.has(link.target);
  const chosen = new Map(key ? links.filter(isChosen).map((one) => [one.id, one]) : []);
  const ends = new Set([...chosen.values()].flatMap(({ link }) => [link.source, link.target]));
  return { nodes, links: chosen, ends };
}

// All links between two boxes through one proxy, or past all of them, are a line. Of very many,
// those with a problem stay, then those that are chosen.
export function linesOf(links, on) {
  const lines = new Map();
  for (const one of links) {
    if (!one.line) continue;
    if (!lines.has(one.line)) {
      lines.set(one.line, { id: one.line, a: one.a, b: one.b, via: one.via, links: [], state: "ok", flow: "still", forth: false, back: false, on: false });
    }
    addLink(lines.get(one.line), one, on.links.has(one.id));
  }
  if (lines.size <= MOST_LINES) return { lines, left: [] };
  const rank = (line) => Math.max(1, RANK[line.state]) * 2 + Number(line.on);
  const sorted = [...lines.values()].sort((p, q) => rank(q) - rank(p) || q.links.length - p.links.length || compare(p.id, q.id));
  return { lines: new Map(sorted.slice(0, MOST_LINES).map((line) => [line.id, line])), left: sorted.slice(MOST_LINES) };
}

const FLOWS = ["still", "uncounted", "flows"];

function addLink(line, one, isOn) {
  const state = one.link.state || "unknown";
  const flow = flowOf(one.link);
  line.links.push(one);
  if (RANK[state] > RANK[line.state]) line.state = state;
  if (FLOWS.indexOf(flow) > FLOWS.indexOf(line.flow)) line.flow = flow;
  line.on = line.on || isOn;
  if (one.turned) line.back = true;
  else line.forth = true;
}

// Places

// Where everything stands in a picture of this width: rectangles of boxes, of rows, of proxies and
// of the frames around them, and the way of each line.
export function layout(lanes, lines, proxies, width) {
  const columns = columnsOf(width);
  const places = { columns, isNarrow: width < NARROW, boxes: new Map(), frames: new Map(), rows: new Map(), heads: new Map(), ways: new Map() };
  const [outside, host, inside] = lanes;
  const bottoms = [stack(outside, columns[0], 0, places)];
  const carriers = carriersOf(lines, proxies, places);
  const rank = new Map(carriers.map(({ id, proxy }, index) => [proxy ? labelOf(id, proxy) : "", index]));
  const rankOf = (box) => rank.get(box.owner) ?? rank.size;
  const sorted = [...inside].sort((p, q) => rankOf(p) - rankOf(q));
  bottoms.push(stack(sorted, columns[2], 0, places));
  bottoms.push(stack(host, columns[1], stackRows(lines, carriers, places), places));
  places.width = columns[2].x + columns[2].w;
  places.height = Math.max(...bottoms);
  addWays(lines, places);
  return places;
}

function columnsOf(width) {
  const whole = Math.max(width, LEAST_WIDTH);
  const side = Math.round(whole * 0.27);
  const channel = Math.round(whole * 0.08);
  const middle = whole - 2 * side - 2 * channel;
  return [{ x: 0, w: side }, { x: side + channel, w: middle }, { x: whole - side, w: side }];
}

// Boxes below each other, with a frame around each group of several boxes; returns where they end.
function stack(boxes, column, top, places) {
  let y = top;
  for (let first = 0; first < boxes.length;) {
    let end = first + 1;
    while (end < boxes.length && boxes[end].place === boxes[first].place) end += 1;
    const framed = end - first > 1;
    const start = y;
    if (framed) y += GAP;
    for (const box of boxes.slice(first, end)) {
      const indent = framed ? GAP + INDENT * box.level : 0;
      places.boxes.set(box.id, { x: column.x + indent, y, w: column.w - indent - (framed ? GAP : 0), h: BOX });
      y += BOX + GAP;
    }
    if (framed) places.frames.set(boxes[first].place, { x: column.x, y: start, w: column.w, h: y - start });
    y += framed ? PAD : GAP;
    first = end;
  }
  return y;
}

// The proxies with their lines, in the order of the ends outside, so that few lines cross; and the
// lines past the proxies.
function carriersOf(lines, proxies, places) {
  const found = [...proxies].map(([id, proxy]) => ({ id, proxy, lines: [], y: 0 })).sort((p, q) => compare(p.id, q.id));
  const carriers = new Map([...found, { id: DIRECT, lines: [] }].map((one) => [one.id, one]));
  for (const line of lines.values()) carriers.get(line.via).lines.push(line);
  for (const one of found) {
    const ends = one.lines.map((line) => heightOf(line.a, places));
    one.y = ends.length ? ends.reduce((sum, y) => sum + y, 0) / ends.length : Number.MAX_VALUE;
  }
  return [...found.sort((p, q) => p.y - q.y), carriers.get(DIRECT)];
}

function heightOf(id, places) {
  return (places.boxes.get(id) || { y: 0 }).y;
}

// A frame for each proxy with the rows of its lines, and one for the lines past the proxies.
function stackRows(lines, carriers, places) {
  const column = places.columns[1];
  let y = 0;
  for (const { id: via, proxy, lines: carried } of carriers) {
    const middle = new Map(carried.map((line) => [line, heightOf(line.a, places) + heightOf(line.b, places)]));
    const own = carried.sort((p, q) => middle.get(p) - middle.get(q) || compare(p.id, q.id));
    if (via === DIRECT && !own.length) continue;
    const start = y;
    const head = { x: column.x + GAP, y: y + GAP, w: column.w - 2 * GAP, h: BOX + (proxy?.detail ? FIX : 0) };
    places.heads.set(via, head);
    y += head.h + 2 * GAP;
    for (const line of own) {
      const h = ROW + (hasFix(line) || places.isNarrow ? FIX : 0) + (isHairpin(line, places) ? GAP : 0);
      places.rows.set(line.id, { x: column.x + GAP, y, w: column.w - 2 * GAP, h });
      y += h + GAP;
    }
    places.frames.set(`v:${via}`, { x: column.x, y: start, w: column.w, h: y - start });
    y += PAD;
  }
  return y;
}

export function hasFix(line) {
  return RANK[line.state] >= 2;
}

// Both ends are on the same side of the middle lane. (Boxes on the host have no place yet here.)
function isHairpin(line, places) {
  return sideOf(line.a, places) === sideOf(line.b, places);
}

function sideOf(id, places) {
  const box = places.boxes.get(id);
  return box && box.x >= places.columns[2].x ? "right" : "left";
}

// The ends of lines are spread over the edge of their box in the order of their rows.
function addWays(lines, places) {
  const ends = new Map();
  for (const line of lines.values()) {
    for (const id of [line.a, line.b]) {
      if (!ends.has(id)) ends.set(id, []);
      ends.get(id).push(line);
    }
  }
  const heights = new Map();
  for (const [id, own] of ends) {
    const box = places.boxes.get(id);
    own.sort((p, q) => places.rows.get(p.id).y - places.rows.get(q.id).y);
    own.forEach((line, index) => heights.set(`${line.id} ${id}`, Math.round(box.y + (box.h * (index + 1)) / (own.length + 1))));
  }
  for (const line of lines.values()) {
    const [a, b] = [line.a, line.b].map((id) => endOf(id, heights.get(`${line.id} ${id}`), places));
    places.ways.set(line.id, wayOf(line, a, b, places.rows.get(line.id), places));
  }
}

// Where a line leaves a box: at the edge that faces a channel.
function endOf(id, y, places) {
  const box = places.boxes.get(id);
  const [outside, host] = places.columns;
  if (box.x < host.x) return { x: box.x + box.w, y, edge: outside.w, side: "left", faces: 1 };
  const side = sideOf(id, places);
  return { x: box.x, y, edge: side === "left" ? host.x : places.columns[2].x, side, faces: -1 };
}

function wayOf(line, a, b, row, places) {
  const frame = places.columns[1];
  const edges = { left: frame.x, right: frame.x + frame.w };
  const hairpin = a.side === b.side;
  const y = row.y + row.h - 3 - (hairpin ? GAP : 0);
  const far = a.side === "left" ? edges.right - 2 * GAP : edges.left + 2 * GAP;
  const sweep = a.side === "left" ? 1 : 0;
  const through = hairpin ? `H${far} a2,2 0 0 ${sweep} 0,${GAP} H${edges[b.side]}` : `H${edges[b.side]}`;
  const out = hairpin ? y + GAP : y;
  return {
    d: `M${a.x},${a.y} H${a.edge} ${curve(a.edge, a.y, edges[a.side], y)} ${through} ${curve(edges[b.side], out, b.edge, b.y)} H${b.x}`,
    arrows: [line.forth ? arrow(b) : "", line.back ? arrow(a) : ""].join(""),
  };
}

// A curve in a channel, flat at both ends. A box on the host is on the same edge as its row: the
// longer such a curve, the wider.
function curve(x, y, toX, toY) {
  const bend = x === toX ? x - Math.min(7 * PAD, 2 * PAD + Math.abs(toY - y) / PAD) : (x + toX) / 2;
  return `C${bend},${y} ${bend},${toY} ${toX},${toY}`;
}

function arrow({ x, y, faces }) {
  return `M${x},${y}l${8 * faces},-4v8z`;
}

const { compare } = new Intl.Collator("en", { numeric: true }); // 10.0.0.9 comes before 10.0.0.10
