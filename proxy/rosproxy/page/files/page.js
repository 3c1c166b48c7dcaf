// The page: takes the document and its changes from /events, and shows it as a graph and a table.
//
// All that comes from nodes goes through textContent, or is painted on a canvas; nothing is parsed.
// However many changes come, it is drawn twice a second at most, and only what differs is touched.

import { age, apply, boxesOf, hertz, labelOf, linesOf, megabytes, positions, visibleLinks, visibleNodes,
  WORDS } from "./view.js";

const AT_MOST_EVERY = 500;
const MOST_ROWS = 400;
const MOST_FINDINGS = 30;
const MOST_LABELS = 80;
const LONGEST_FIX = 120;
const AGAIN = 5000;
const SILENT = 40000; // the proxy says something every 15 s
const LOST = "Not connected; what is shown may be old. Trying again…";

const $ = (id) => document.getElementById(id);
const state = { nodes: new Map(), links: new Map(), proxy: {}, findings: [], left_out: 0 };
const chosen = { unfolded: new Set(), unfoldAll: false, quiet: false, filter: "" };
const rows = new Map();
const nodeRows = new Map();
const findings = new Map();
const folds = new Map();
let source = null;
let heard = 0;
let drawing = null;
let lines = new Map(); // those of the graph as it is drawn
let clock = 0; // how many seconds the proxy's is ahead
let selected = "";
let fitted = 0;
let cy = null;

// Events

function listen() {
  if (source) source.close();
  const own = source = new EventSource("events");
  heard = Date.now();
  const on = (kind, use) => own.addEventListener(kind, (event) => { heard = Date.now(); use(event.data); });
  on("clock", (data) => { clock = Number(data) - Date.now() / 1000; });
  on("all", (data) => {
    state.nodes.clear();
    state.links.clear();
    take(JSON.parse(data));
    put($("connection"), "Live");
  });
  on("change", (data) => take(JSON.parse(data)));
  own.addEventListener("error", () => {
    put($("connection"), LOST);
    if (own === source && own.readyState === EventSource.CLOSED) {
      setTimeout(() => { if (own === source) listen(); }, AGAIN);
      // Who is to give the token again sees nothing else than that here.
      fetch("graph").then((answer) => { if (answer.status === 403) location.reload(); }, () => {});
    }
  });
}

// A connection may be cut off without an end, and a browser waits for one for hours.
function watch() {
  if (Date.now() - heard < SILENT) return;
  put($("connection"), LOST);
  listen();
}

function take(update) {
  apply(state.nodes, update.nodes);
  apply(state.links, update.links);
  for (const key of ["proxy", "findings", "left_out"]) if (key in update) state[key] = update[key];
  draw();
}

// By the clock: a page in the background has no frames, but its title is to be seen.
function draw() {
  if (drawing === null) drawing = setTimeout(() => { drawing = null; show(); }, AT_MOST_EVERY);
}

// Drawing

function show() {
  const found = visibleLinks(state.links, state.nodes, chosen);
  const items = troubles();
  showHead(found, items);
  showFindings(items);
  showLinks(found);
  showNodes();
  showGraph(found);
  showDetails();
}

function showHead(found, items) {
  const { proxy } = state;
  put($("host"), proxy.host || "");
  const ports = proxy.ports ? `ports ${proxy.ports}: ${proxy.used} used, ${proxy.free} free` : "";
  const parts = [`${state.nodes.size} nodes`, `${found.length} links`, ports,
    proxy.plane ? `forwards by ${proxy.plane}` : "", proxy.version ? `version ${proxy.version}` : ""];
  put($("summary"), parts.filter(Boolean).join(" · "));
  const broken = items.filter((item) => item.kind === "broken").length;
  const title = broken ? `(${broken} broken) rosproxy` : "rosproxy";
  if (document.title !== title) document.title = title;
}

// All that is wrong, what is broken first: those with one text and one fix are one.
function troubles() {
  const told = new Map();
  const tell = (what, kind, text, fix) => {
    const key = JSON.stringify([kind, text, fix]);
    const known = told.get(key);
    if (known) known.what.push(what);
    else told.set(key, { what: [what], kind, text, fix });
  };
  for (const one of state.findings) tell(one.subject, one.severity === "error" ? "broken" : "warning", one.text, one.fix);
  for (const link of state.links.values()) {
    if (link.state !== "broken" && link.state !== "warning") continue;
    const ends = [link.source, link.target].filter(Boolean).map((id) => labelOf(id, state.nodes.get(id)));
    tell(`${link.name} from ${ends.join(" to ")}`, link.state, link.text || "", link.fix || "");
  }
  for (const [id, node] of state.nodes) {
    if (node.state === "broken" || node.state === "warning") tell(labelOf(id, node), node.state, node.text || "", node.fix || "");
  }
  return [...told.values()].sort((a, b) => (a.kind === "broken" ? 0 : 1) - (b.kind === "broken" ? 0 : 1));
}

function showFindings(items) {
  const shown = new Map(items.slice(0, MOST_FINDINGS).map((item) => {
    const more = item.what.length > 3 ? ` and ${item.what.length - 3} more` : "";
    const what = `${WORDS[item.kind]}: ${item.what.slice(0, 3).join("; ")}${more}`;
    return [JSON.stringify([item.kind, item.text, item.fix]), [item.kind, what, item.text, item.fix]];
  }));
  const rest = items.length - shown.size;
  if (rest > 0) shown.set("rest", ["", `and ${rest} more`, "", ""]);
  if (!items.length) shown.set("none", ["none", "Nothing wrong was found.", "", ""]);
  // A screen reader says what is put in: so what is there already stays.
  arrange($("findings"), findings, shown, ([kind]) => {
    const li = make("li", "", kind);
    li.append(make("div", "", "what"), make("div"), make("code", "", "fix"));
    return li;
  }, (li, [, ...texts]) => texts.forEach((text, index) => put(li.children[index], text)));
}

const LINK_HEADS = ["State", "Name", "From", "To", "Carried by", "Port", "Hz", "MB/s", "Last message", "What is wrong"];
const NODE_HEADS = ["State", "Name", "Where", "Address", "Ports", "MB/s", "What is wrong"];
const NUMBERS = new Set(["Port", "Hz", "MB/s", "Last message"]);
const PLACES = { robot: "robot, outside", host: "host", container: "container, inside" };

function showLinks(found) {
  const now = Date.now() / 1000 + clock;
  const listed = found.slice(0, MOST_ROWS);
  showRows($("rows"), rows, LINK_HEADS, listed.map(({ id, link, from, to }) => {
    const kind = link.kind === "topic" ? "" : ` (${link.kind})`;
    return { id, one: link, texts: [link.name + kind, from, to || "–", link.carried || "–", link.port || "–",
      hertz(link), megabytes(link), age(link, now)] };
  }));
  put($("more"), [tellRest(found.length - listed.length),
    state.left_out ? `${state.left_out} more are not sent to the page.` : ""].filter(Boolean).join(" "));
}

function showNodes() {
  const found = visibleNodes(state.nodes, chosen);
  const listed = found.slice(0, MOST_ROWS);
  showRows($("node-rows"), nodeRows, NODE_HEADS, listed.map(({ id, node, label }) => {
    const kind = (node.kind || "node") === "node" ? "" : ` (${node.kind})`;
    const where = PLACES[node.lane] + (node.proxy ? ` of ${node.proxy}` : "");
    return { id, one: node, texts: [label + kind, where, node.address || "–", node.ports || "–", megabytes(node)] };
  }));
  put($("more-nodes"), tellRest(found.length - listed.length));
}

function tellRest(count) {
  return count > 0 ? `${count} more: narrow it down by a name.` : "";
}

// The rows of a table, in this order: each with its state first, and with what is wrong last.
function showRows(body, elements, heads, listed) {
  arrange(body, elements, new Map(listed.map((row) => [row.id, row])), () => makeRow(heads), (row, { one, texts }) => {
    const kind = one.state || "unknown";
    [WORDS[kind], ...texts].forEach((text, index) => put(row.cells[index], String(text)));
    if (row.dataset.state !== kind) {
      row.dataset.state = kind;
      row.cells[0].className = `state ${kind}`;
    }
    put(row.lastChild.firstChild, one.text || "");
    put(row.lastChild.lastChild, one.fix || "");
  });
}

// Its roles are said: on a phone rows and cells are blocks, which have none of their own.
function makeRow(heads) {
  const row = make("tr");
  row.setAttribute("role", "row");
  heads.forEach((head) => {
    const cell = make("td", "", head === "State" ? "state" : NUMBERS.has(head) ? "number" : "");
    cell.setAttribute("role", "cell");
    cell.dataset.head = head;
    row.append(cell);
  });
  row.lastChild.append(make("span"), make("code", "", "fix"));
  return row;
}

function showGraph(found) {
  if (!cy) return;
  const shown = new Set();
  for (const [id, node] of state.nodes) if ((node.kind || "node") !== "node") shown.add(id);
  for (const { link } of found) { shown.add(link.source); if (link.target) shown.add(link.target); }
  if (!chosen.filter) for (const [id, node] of state.nodes) if (chosen.quiet || labelOf(id, node) !== "/rosout") shown.add(id);
  const { boxOf, boxes, folds: spaces } = boxesOf(state.nodes, shown, chosen);
  lines = linesOf(found, boxOf);
  const places = positions(boxes);
  const wanted = new Map();
  const now = Date.now() / 1000 + clock;
  let fixes = 0;
  for (const box of boxes.values()) {
    const count = box.fold ? ` (${box.count})` : "";
    wanted.set(box.id, { group: "nodes", position: places.get(box.id),
      data: { id: box.id, label: box.label + count, state: box.state, kind: box.fold ? "fold" : box.kind, fold: box.fold, node: box.node } });
  }
  for (const line of lines.values()) {
    const same = boxes.get(line.from).lane === boxes.get(line.to).lane ? "yes" : "no";
    const wrong = line.state === "broken" || line.state === "warning";
    const labelled = wrong ? (fixes += 1) <= MOST_LABELS : lines.size <= MOST_LABELS;
    wanted.set(line.id, { group: "edges", data: { id: line.id, source: line.from, target: line.to, state: line.state,
      same, flows: line.flows ? "yes" : "no", label: labelled ? lineLabel(line, now) : "" } });
  }
  cy.batch(() => {
    cy.elements().forEach((one) => { if (!wanted.has(one.id())) one.remove(); });
    const added = [];
    for (const [id, one] of wanted) {
      const known = cy.getElementById(id);
      if (known.empty()) { added.push(one); continue; }
      for (const [key, value] of Object.entries(one.data)) if (known.data(key) !== value) known.data(key, value);
      if (one.position) {
        const at = known.position();
        if (at.x !== one.position.x || at.y !== one.position.y) known.position(one.position);
      }
    }
    cy.add(added.filter((one) => one.group === "nodes"));
    cy.add(added.filter((one) => one.group === "edges"));
  });
  if (selected && cy.getElementById(selected).empty()) selected = "";
  if (fitted !== boxes.size && !selected) { fitted = boxes.size; cy.fit(undefined, 24); }
  showFolds(spaces);
}

// What stands at a line: what is wrong first with its fix; else what is known of its one link.
function lineLabel(line, now) {
  const { link } = line.links[0]; // the worst: see visibleLinks
  const more = line.links.length > 1 ? ` and ${line.links.length - 1} more` : "";
  if (line.state === "broken" || line.state === "warning") {
    return [`${WORDS[line.state]}: ${link.name}${more}`, short(link.fix || link.text)].filter(Boolean).join("\n");
  }
  if (more) return `${line.links.length} links`;
  const measures = [link.hz === undefined ? "" : `${hertz(link)} Hz`, link.rate === undefined ? "" : `${megabytes(link)} MB/s`,
    link.carried || "", link.flows || link.since === undefined ? "" : age(link, now)];
  return [link.name, measures.filter(Boolean).join(", ")].filter(Boolean).join("\n");
}

function short(text = "") {
  return text.length > LONGEST_FIX ? `${text.slice(0, LONGEST_FIX)}…` : text;
}

function showFolds(spaces) {
  const sorted = [...spaces].sort((a, b) => (a.key < b.key ? -1 : 1));
  $("namespaces").hidden = sorted.length === 0;
  arrange($("folds"), folds, new Map(sorted.map((fold) => [fold.key, fold])), (fold) => {
    const button = make("button");
    button.type = "button";
    button.addEventListener("click", () => toggle(fold.key));
    return button;
  }, (button, fold) => {
    put(button, `${fold.label} (${fold.count})`);
    if (button.getAttribute("aria-expanded") !== String(fold.open)) button.setAttribute("aria-expanded", String(fold.open));
  });
}

function toggle(key) {
  if (!chosen.unfolded.delete(key)) chosen.unfolded.add(key);
  fitted = 0;
  show();
}

function showDetails() {
  const element = selected && cy ? cy.getElementById(selected) : null;
  const parts = element && element.nonempty() ? details(element) : [];
  const kinds = parts.map(([kind]) => kind).join(" ");
  if ($("details").dataset.kinds !== kinds) $("details").replaceChildren(...parts.map(([kind]) => make(kind)));
  $("details").dataset.kinds = kinds;
  parts.forEach(([, text], index) => put($("details").children[index], text));
}

function details(element) {
  if (element.isNode()) {
    const node = state.nodes.get(element.data("node")) || {};
    const ports = node.ports ? `ports ${node.ports}` : "";
    const rate = node.rate === undefined ? "" : `${megabytes(node)} MB/s through it`;
    return [["h3", element.data("label")], ["p", [node.address, ports, rate].filter(Boolean).join(" · ")],
      ["p", node.text || ""], ["code", node.fix || ""]].filter(([, text]) => text);
  }
  const ends = [element.source().id(), element.target().id()];
  const line = lines.get(element.id());
  const now = Date.now() / 1000 + clock;
  const parts = [["h3", ends.map((id) => cy.getElementById(id).data("label")).join(" to ")]];
  for (const { link } of (line ? line.links : []).slice(0, 20)) {
    parts.push(["p", `${WORDS[link.state || "unknown"]}: ${link.name}, ${hertz(link)} Hz, ${megabytes(link)} MB/s, ` +
      `last message ${age(link, now)}, carried by ${link.carried || "–"}, port ${link.port || "–"}`]);
    if (link.text) parts.push(["p", link.text], ["code", link.fix || ""]);
  }
  return parts;
}

// The canvas

function style() {
  const own = getComputedStyle(document.documentElement);
  const colour = (name) => own.getPropertyValue(`--${name}`).trim();
  const states = ["ok", "unknown", "warning", "broken"];
  return [
    { selector: "node", style: { label: "data(label)", shape: "round-rectangle", width: 150, height: 30,
      "background-color": colour("back"), "border-width": 1.5, color: colour("text"), "font-size": 11,
      "text-valign": "center", "text-halign": "center", "text-wrap": "ellipsis", "text-max-width": 140,
      "min-zoomed-font-size": 5 } },
    { selector: "node[kind = 'fold']", style: { "border-style": "double", "border-width": 4 } },
    { selector: "node[kind = 'proxy'], node[kind = 'master']", style: { shape: "hexagon" } },
    { selector: "edge", style: { width: 2, "curve-style": "straight", "target-arrow-shape": "triangle", "arrow-scale": 0.8,
      "source-label": "data(label)", "source-text-offset": 122, "source-text-rotation": "autorotate",
      "font-size": 9, color: colour("text"), "text-wrap": "wrap", "text-overflow-wrap": "anywhere", "text-max-width": 230, "text-background-color": colour("box"),
      "text-background-opacity": 0.85, "text-background-padding": 2, "min-zoomed-font-size": 6 } },
    { selector: "edge[same = 'yes']", style: { "curve-style": "unbundled-bezier", "control-point-distances": 110, "control-point-weights": 0.5 } },
    { selector: "edge[flows = 'no']", style: { "line-style": "dashed" } },
    ...states.map((name) => ({ selector: `node[state = '${name}']`, style: { "border-color": colour(name) } })),
    ...states.map((name) => ({ selector: `edge[state = '${name}']`, style: { "line-color": colour(name), "target-arrow-color": colour(name) } })),
    { selector: "edge[state = 'broken']", style: { width: 4, "text-background-opacity": 1, "z-index": 2 } },
    { selector: ":selected", style: { "border-width": 4, "overlay-opacity": 0.12 } },
  ];
}

function start() {
  cy = window.cytoscape({ container: $("graph"), style: style(), layout: { name: "preset" }, minZoom: 0.05, maxZoom: 3,
    autoungrabify: true, boxSelectionEnabled: false, hideEdgesOnViewport: true, textureOnViewport: true, pixelRatio: 1 });
  cy.on("tap", "node", (event) => { const fold = event.target.data("fold"); if (fold) toggle(fold); });
  cy.on("select unselect", () => { selected = cy.$(":selected").map((one) => one.id())[0] || ""; showDetails(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => cy.style(style()));
  addEventListener("resize", () => { fitted = 0; draw(); });
  $("controls").addEventListener("submit", (event) => event.preventDefault());
  $("filter").addEventListener("input", (event) => { chosen.filter = event.target.value; fitted = 0; draw(); });
  $("quiet").addEventListener("change", (event) => { chosen.quiet = event.target.checked; fitted = 0; draw(); });
  $("unfold").addEventListener("change", (event) => { chosen.unfoldAll = event.target.checked; fitted = 0; draw(); });
  setInterval(() => { draw(); watch(); }, 1000); // ages grow
  // For tests, and whoever looks into it: the graph itself.
  window.rosproxyPage = { cy, state };
  listen();
}

function make(tag, text = "", name = "") {
  const element = document.createElement(tag);
  if (text) element.textContent = text;
  if (name) element.className = name;
  return element;
}

// Elements in this order, one for each key: what is there stays, with the focus or what is marked.
function arrange(parent, elements, wanted, create, update) {
  for (const [key, element] of elements) if (!wanted.has(key)) { element.remove(); elements.delete(key); }
  let place = parent.firstChild;
  for (const [key, one] of wanted) {
    if (!elements.has(key)) elements.set(key, create(one));
    const element = elements.get(key);
    update(element, one);
    if (element === place) place = place.nextSibling;
    else parent.insertBefore(element, place);
  }
}

function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

start();
