// The page: takes the document and its changes from /events, and shows it as a graph and a table.
//
// All that comes from nodes goes through textContent, or into attributes; nothing is parsed.
// However many changes come, it is drawn twice a second at most, and only what differs is touched.

import { ageOf, causesOf, connect, emptyMemory, follow, followNodes, partsOf, titleOf } from "./findings.js";
import { curveOf, emptyHistory, lastMinute, minuteText, record } from "./history.js";
import { boxesOf, DIRECT, hasFix, joined, layout, linesOf, selection } from "./picture.js";
import { age, apply, duration, frequency, hertz, isKnown, labelOf, megabytes, placeOf, rateOf, visibleLinks, visibleNodes, WORDS } from "./view.js";
import { zoomable } from "./zoom.js";

const AT_MOST_EVERY = 500;
const MOST_ROWS = 400;
const MOST_FINDINGS = 30;
const MOST_CHOSEN = 20;
const AGAIN = 5000;
const SILENT = 40000; // the proxy says something every 15 s
const KNOWN = 20000; // after an event: until then the rates hold
const CURVE = { width: 240, height: 28 };
const LOST = "Not connected; what is shown may be old. Trying again…";

const $ = (id) => document.getElementById(id);
const state = { nodes: new Map(), links: new Map(), proxy: {}, findings: [], left_out: 0 };
const chosen = { turned: new Map(), unfoldAll: false, quiet: false, filter: "", depths: {} };
const rows = new Map();
const nodeRows = new Map();
const findings = new Map();
const eventRows = new Map();
const seen = new Map(); // causes, with the time of their beginning
const memory = emptyMemory(); // of nodes and proxies
let events = [];
let isFirst = true; // no document was shown yet
const boxes = new Map();
const ways = new Map();
const zoom = zoomable($("graph"), $("zoomed"), { less: $("zoom-less"), more: $("zoom-more"), fit: $("zoom-fit"), level: $("zoom-level") }, show);
let source = null;
let heard = 0;
const rates = emptyHistory(Date.now()); // of the last minute
let knownUntil = 0; // the time in milliseconds until which the rates are known
let drawing = null;
let clock = 0; // how many seconds the proxy's is ahead
let selected = ""; // "n:" and a node, "k:" and a link, or the key of a box, a line or a cause

// Events

function listen() {
  if (source) source.close();
  const own = source = new EventSource("events");
  heard = Date.now();
  const on = (kind, use) => own.addEventListener(kind, (event) => {
    note();
    heard = Date.now();
    knownUntil = heard + KNOWN;
    use(event.data);
  });
  on("clock", (data) => { clock = Number(data) - Date.now() / 1000; });
  on("all", (data) => {
    state.nodes.clear();
    state.links.clear();
    connect(memory, heard);
    take(JSON.parse(data));
    put($("connection"), "Live");
  });
  on("change", (data) => take(JSON.parse(data)));
  own.addEventListener("error", () => {
    put($("connection"), LOST);
    note();
    knownUntil = Math.min(knownUntil, Date.now());
    if (own === source && own.readyState === EventSource.CLOSED) {
      setTimeout(() => { if (own === source) listen(); }, AGAIN);
      // Who is to give the token again sees nothing else than that here.
      fetch("graph").then((answer) => { if (answer.status === 403) location.reload(); }, () => {});
    }
  });
}

function note() {
  record(rates, state.links, Date.now(), knownUntil);
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
  const causes = causesOf(state, clock);
  const now = Date.now();
  events = followNodes(memory, state, follow(seen, causes, events, now, isFirst), now);
  isFirst = isFirst && state.nodes.size === 0;
  showHead(found, causes);
  const on = showGraph(found, causes.find(({ key }) => key === selected));
  showFindings(causes, on);
  showEvents();
  showLinks(found, on.links);
  showNodes(on.nodes);
  showDetails(on);
  writeAddress();
}

function showHead(found, causes) {
  const { proxy } = state;
  put($("host"), proxy.host || "");
  const ports = proxy.ports ? `ports ${proxy.ports}: ${proxy.used} used, ${proxy.free} free` : "";
  const parts = [`${state.nodes.size} nodes`, `${found.length} links`, ports,
    proxy.plane ? `forwards by ${proxy.plane}` : "", proxy.version ? `version ${proxy.version}` : ""];
  put($("summary"), parts.filter(Boolean).join(" · "));
  const broken = causes.filter(({ kind }) => kind === "broken").length;
  const warnings = causes.length - broken;
  put($("count"), [broken ? `${broken} broken` : "", warnings ? `${warnings} warning${warnings > 1 ? "s" : ""}` : ""].filter(Boolean).join(", "));
  const title = broken ? `(${broken} broken) rosproxy` : "rosproxy";
  if (document.title !== title) document.title = title;
}

// A line for each cause. A screen reader says what is put in: so what is there already stays, and
// ages are hidden from screen readers.
function showFindings(causes, on) {
  const shown = new Map(causes.slice(0, MOST_FINDINGS).map((cause) => {
    const { kind, text, fix, nodes, links } = cause;
    const { since } = seen.get(cause.key);
    const isOn = cause.key === selected || [...nodes].some((id) => on.nodes.has(id)) || [...links].some((id) => on.links.has(id));
    return [cause.key, { key: cause.key, kind, isOn, what: `${WORDS[kind]}: ${titleOf(cause)}`, text, fix,
      since: ageOf(cause, (Date.now() - since) / 1000) }];
  }));
  const rest = causes.length - shown.size;
  if (rest > 0) shown.set("rest", { kind: "", what: `and ${rest} more` });
  if (!causes.length) shown.set("none", { kind: "none", what: "Nothing wrong was found." });
  arrange($("findings"), findings, shown, makeFinding, updateFinding);
}

function makeFinding({ key, kind }) {
  const li = make("li", "", kind);
  if (!key) {
    li.append(make("span", "", "what"));
    return li;
  }
  const cause = make("button", "", "cause");
  cause.type = "button";
  cause.append(make("span", "", "what"), make("span", "", "text"));
  cause.addEventListener("click", () => choose(key, true));
  const since = make("span", "", "since");
  since.setAttribute("aria-hidden", "true");
  li.append(cause, ...makeFix(), since);
  return li;
}

// A fix, with a button that copies the command in the fix. Several commands have a button each. A fix
// without a command has a button that copies the whole fix.
function makeFix() {
  return [make("code", "", "fix"), make("span", "", "copies")];
}

// `what`: what the fix is for, which screen readers say at the button.
function putFix(parent, text, what) {
  const [fix, copies] = [parent.querySelector(".fix"), parent.querySelector(".copies")];
  if (fix.textContent !== text) {
    fix.replaceChildren(...partsOf(text).map(([part, isCommand]) => isCommand ? make("span", part, "command") : part));
    const commands = [...fix.querySelectorAll(".command")];
    copies.replaceChildren(...(commands.length || !text ? commands : [fix]).map(makeCopy));
  }
  for (const button of copies.children) {
    const label = button.textContent !== button.value ? button.textContent
      : button.title ? `Copy the command ${button.title} for ${what}` : `Copy the fix for ${what}`;
    if (button.ariaLabel !== label) button.ariaLabel = label;
  }
}

function makeCopy(element, index, { length }) {
  const button = make("button", length > 1 ? `Copy ${index + 1}` : "Copy", "copy");
  button.type = "button";
  button.value = button.textContent;
  if (element.className === "command") button.title = element.textContent;
  button.addEventListener("click", () => copy(element, button));
  return button;
}

function updateFinding(li, { key, isOn, what, text, fix, since }) {
  put(li.querySelector(".what"), what);
  if (!key) return;
  put(li.querySelector(".text"), text);
  putFix(li, fix, what);
  put(li.querySelector(".since"), since);
  mark(li, isOn);
}

// navigator.clipboard exists only on pages of https and of loopback.
function copy(element, button) {
  getSelection().selectAllChildren(element);
  put(button, document.execCommand("copy") ? "Copied" : "Not copied");
  button.ariaLabel = button.textContent;
  getSelection().removeAllRanges();
  setTimeout(() => put(button, button.value), 2000);
}

function showEvents() {
  const shown = new Map(events.map((event) => [`${event.at} ${event.over} ${event.title}`, event]));
  put($("happened").firstElementChild, events.length ? `What happened (${events.length})` : "What happened: nothing since this page was opened");
  arrange($("events"), eventRows, shown, () => make("li"), (li, { at, over, kind, title, since, older }) => {
    const time = new Date(at).toLocaleTimeString();
    const begin = over ? `over after ${older ? "at least " : ""}${duration((at - since) / 1000)}: ` : kind ? `${WORDS[kind]}: ` : "";
    put(li, `${time} ${begin}${title}`);
  });
}

const LINK_HEADS = ["State", "Name", "From", "To", "Carried by", "Port", "Hz", "MB/s", "Last message", "What is wrong"];
const NODE_HEADS = ["State", "Name", "Where", "Address", "Ports", "MB/s", "What is wrong"];
const NUMBERS = new Set(["Port", "Hz", "MB/s", "Last message"]);
const PLACES = { robot: "robot, outside", host: "host", container: "container, inside" };

function showLinks(found, on) {
  const now = Date.now() / 1000 + clock;
  const listed = found.slice(0, MOST_ROWS);
  showRows($("rows"), rows, LINK_HEADS, listed.map(({ id, link, from, to }) => {
    const kind = link.kind === "topic" ? "" : ` (${link.kind})`;
    return { id, one: link, key: `k:${id}`, what: `${link.name} from ${from}${to ? ` to ${to}` : ""}`, on: on.has(id), texts: [link.name + kind, from, to || "–", link.carried || "–", link.port || "–",
      hertz(link), megabytes(link), age(link, now)] };
  }));
  put($("more"), [tellRest(found.length - listed.length),
    state.left_out ? `${state.left_out} more are not sent to the page.` : ""].filter(Boolean).join(" "));
}

function showNodes(on) {
  const found = visibleNodes(state.nodes, chosen);
  const listed = found.slice(0, MOST_ROWS);
  showRows($("node-rows"), nodeRows, NODE_HEADS, listed.map(({ id, node, label }) => {
    const kind = (node.kind || "node") === "node" ? "" : ` (${node.kind})`;
    const where = (node.place ? `${node.place}, inside` : PLACES[node.lane]) + (node.proxy ? ` of ${node.proxy}` : "");
    return { id, one: node, key: `n:${id}`, what: label, on: on.has(id), texts: [label + kind, where, node.address || "–", node.ports || "–", megabytes(node)] };
  }));
  put($("more-nodes"), tellRest(found.length - listed.length));
}

function tellRest(count) {
  return count > 0 ? `${count} more: narrow it down by a name.` : "";
}

// The rows of a table, in this order: each with its state first, and with what is wrong last.
function showRows(body, elements, heads, listed) {
  arrange(body, elements, new Map(listed.map((row) => [row.id, row])), ({ key }) => makeRow(heads, key), (row, { one, on, what, texts }) => {
    const kind = one.state || "unknown";
    [WORDS[kind], ...texts].forEach((text, index) => putName(row.cells[index], String(text)));
    if (row.dataset.state !== kind) {
      row.dataset.state = kind;
      row.cells[0].className = `state ${kind}`;
    }
    mark(row, on);
    put(row.lastChild.firstChild, one.text || "");
    putFix(row.lastChild, one.fix || "", what);
  });
}

// Its roles are said: on a phone rows and cells are blocks, which have none of their own.
function makeRow(heads, key) {
  const row = make("tr");
  row.addEventListener("click", ({ target }) => { if (!target.closest("button") && !String(getSelection())) choose(key, true); });
  row.setAttribute("role", "row");
  heads.forEach((head) => {
    const cell = make("td", "", head === "State" ? "state" : NUMBERS.has(head) ? "number" : "");
    cell.setAttribute("role", "cell");
    cell.dataset.head = head;
    row.append(cell);
  });
  row.lastChild.append(make("span"), ...makeFix());
  return row;
}

// Draw the graph; returns what is chosen (picture.js, selection).
function showGraph(found, cause) {
  const proxies = new Map([...state.nodes].filter(([, node]) => node.kind === "proxy"));
  const { lanes, boxOf, depths } = boxesOf(state.nodes, shownNodes(found), chosen);
  chosen.depths = depths;
  const links = joined(found, lanes, boxOf, proxies);
  const all = new Map(lanes.flat().map((box) => [box.id, box]));
  const on = selection(selected, links, all, cause);
  on.title = cause ? titleOf(cause) : all.has(selected) ? all.get(selected).label : "";
  const { lines, left } = linesOf(links, on);
  const places = layout(lanes, lines, proxies, Math.floor($("graph").clientWidth / Math.min(1, zoom())) - 16);
  const [chosenBoxes, near] = [on.nodes, on.ends].map((ids) => new Set([...ids].map((id) => boxOf.get(id))));
  for (const box of all.values()) {
    box.on = box.id === selected || chosenBoxes.has(box.id);
    box.near = near.has(box.id);
  }
  showLanes(places);
  showBoxes(lanes, lines, proxies, places, all, on);
  showWays(lines, places);
  $("picture").classList.toggle("narrow", places.isNarrow);
  $("picture").classList.toggle("choosing", on.nodes.size + on.links.size > 0);
  const rest = left.reduce((sum, line) => sum + line.links.length, 0);
  put($("more-lines"), left.length ? `${left.length} more lines with ${rest} links are not drawn. Choose a box to see its lines.` : "");
  return on;
}

function shownNodes(found) {
  const shown = new Set();
  for (const { link } of found) { shown.add(link.source); if (link.target) shown.add(link.target); }
  for (const { id } of visibleNodes(state.nodes, chosen)) shown.add(id);
  return shown;
}

function showLanes(places) {
  places.columns.forEach(({ x, w }, index) => putAt($("lanes").children[index], { x, y: 0, w, h: 24 }));
  for (const one of [$("lanes"), $("picture")]) putAt(one, { x: 0, y: 0, w: places.width, h: one.id === "lanes" ? 24 : places.height });
  const size = `0 0 ${places.width} ${places.height}`;
  if ($("lines").getAttribute("viewBox") !== size) $("lines").setAttribute("viewBox", size);
}

// Boxes, rows of lines, and the frames around them, in the order of the keyboard: lane by lane.
function showBoxes(lanes, lines, proxies, places, all, on) {
  const now = Date.now() / 1000 + clock;
  const wanted = new Map();
  for (const [id, rect] of places.frames) wanted.set(`frame ${id}`, { id: `frame ${id}`, kind: "frame", rect });
  const [outside, host, inside] = lanes.map((lane) => lane.map((box) => boxOfGroup(box, places.boxes.get(box.id))));
  const heads = [...places.heads].map(([id, rect]) => boxOfProxy(id, proxies.get(id), rect, on));
  const rowsOfLines = [...places.rows].map(([id, rect]) => rowOfLine(lines.get(id), rect, all, now));
  for (const one of [...outside, ...heads, ...rowsOfLines, ...host, ...inside]) wanted.set(one.id, one);
  arrange($("boxes"), boxes, wanted, makeBox, updateBox);
}

function boxOfGroup(box, rect) {
  const sign = box.key ? (box.open ? "▾ " : "▸ ") : "";
  return { ...box, rect, texts: [sign + marked(box.state, box.label), box.note, ""], title: `${box.label}\n${box.note}` };
}

function boxOfProxy(id, proxy, rect, on) {
  if (id === DIRECT) return { id: "past", kind: "past", rect, texts: ["past the proxies", "", ""], state: "ok", title: "" };
  const state = proxy.state || "ok";
  const label = labelOf(id, proxy);
  return { id: `n:${id}`, kind: "proxy", rect, state, on: on.nodes.has(id), texts: [marked(state, label), proxy.ports || "", proxy.detail || ""],
    title: [label, proxy.detail, proxy.ports].filter(Boolean).join("\n") };
}

function rowOfLine(line, rect, all, now) {
  const ends = [line.a, line.b].map((id) => all.get(id).label);
  const names = line.forth ? ends : [ends[1], ends[0]];
  const [what, note, fix] = lineTexts(line, now);
  return { id: line.id, kind: "line", rect, state: line.state, on: line.on, texts: [what, note, fix], from: names[0], to: names[1],
    title: `${names.join(line.forth && line.back ? " ↔ " : " → ")}\n${what}\n${note}` };
}

function marked(state, label) {
  return (state === "broken" ? "✖ " : state === "warning" ? "⚠ " : "") + label;
}

// What stands at a line: what is wrong first with its fix; else what is known of its links.
function lineTexts(line, now) {
  const { link } = line.links[0]; // the worst: see visibleLinks
  const count = line.links.length;
  const what = count > 1 ? `${link.name} and ${count - 1} more` : link.name;
  if (hasFix(line)) return [`${WORDS[line.state]}: ${what}`, "", link.fix || link.text || ""];
  const sum = rateOf(line.links.map((one) => one.link));
  const rate = sum.rate === undefined ? "" : `${megabytes(sum)} MB/s`;
  if (count > 1) return [what, rate, ""];
  const measures = link.flows || !isKnown(link.since) ? [frequency(link), rate] : [`last ${age(link, now)}`];
  return [what, [...measures, link.carried].filter(Boolean).join(", "), ""];
}

function makeBox({ kind }) {
  if (kind === "frame") return make("div", "", "frame");
  const box = make(kind === "past" ? "p" : "button", "", `box ${kind}`);
  box.append(make("span", "", "what"), make("span", "", "note"), make("span", "", "fix"));
  if (kind !== "past") {
    box.type = "button";
    box.addEventListener("click", () => press(box));
  }
  return box;
}

function updateBox(element, one) {
  putAt(element, one.rect);
  const data = { id: one.id, state: one.state || "", key: one.key || "", from: one.from || "", to: one.to || "" };
  for (const [key, value] of Object.entries(data)) if (element.dataset[key] !== value) element.dataset[key] = value;
  if (one.kind === "frame") return;
  one.texts.forEach((text, index) => put(element.children[index], text));
  if (element.title !== one.title) element.title = one.title;
  const spoken = [...one.title.split("\n").filter(Boolean), WORDS[one.state]].join(", ");
  if (one.kind !== "past" && element.ariaLabel !== spoken) element.ariaLabel = spoken;
  mark(element, Boolean(one.on));
  element.classList.toggle("near", Boolean(one.near));
  if (one.key && element.getAttribute("aria-expanded") !== String(one.open)) element.setAttribute("aria-expanded", String(one.open));
}

function showWays(lines, places) {
  const wanted = new Map([...places.ways].map(([id, way]) => [id, { way, line: lines.get(id) }]));
  const svg = $("lines");
  arrange(svg, ways, wanted, () => {
    const group = document.createElementNS(svg.namespaceURI, "g");
    for (const name of ["way", "arrow"]) {
      const path = document.createElementNS(svg.namespaceURI, "path");
      path.setAttribute("class", name);
      group.append(path);
    }
    return group;
  }, (group, { way, line }) => {
    setAll([[group, "class", `${line.state} ${line.flow}${line.on ? " on" : ""}`], [group, "data-id", line.id],
      [group.children[0], "d", way.d], [group.children[1], "d", way.arrows]]);
  });
}

// A group unfolds or folds; all else is chosen, or chosen no more.
function press(box) {
  const { key, id } = box.dataset;
  if (key) chosen.turned.set(key, box.getAttribute("aria-expanded") !== "true");
  choose(id, false);
}

function choose(id, reveal) {
  selected = selected === id ? "" : id;
  show();
  if (selected && reveal) $("boxes").querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
}

function mark(element, on) {
  if (on === element.hasAttribute("aria-current")) return;
  if (on) element.setAttribute("aria-current", "true");
  else element.removeAttribute("aria-current");
}

function showDetails(on) {
  if (selected && !isFirst && !on.nodes.size && !on.links.size && !seen.has(selected)) selected = "";
  const parts = selected ? details(on) : [];
  const kinds = parts.map(([kind]) => kind).join(" ");
  if ($("details").dataset.kinds !== kinds) $("details").replaceChildren(...parts.map(([kind]) => makePart(kind)));
  $("details").dataset.kinds = kinds;
  parts.forEach(([kind, text, more], index) => {
    const element = $("details").children[index];
    if (kind === "fix") return putFix(element, text, more);
    put(kind === "figure" ? element.lastChild : element, text);
    if (kind === "figure") setAll([[element.querySelector("path"), "d", more]]);
  });
}

function makePart(kind) {
  if (kind === "figure") return makeCurve();
  const part = make(kind === "fix" ? "p" : kind);
  if (kind === "fix") part.append(...makeFix());
  return part;
}

// A curve and, for all users, the same in words.
function makeCurve() {
  const figure = make("figure");
  const [svg, path] = ["svg", "path"].map((name) => document.createElementNS($("lines").namespaceURI, name));
  setAll([[svg, "viewBox", `0 -2 ${CURVE.width} ${CURVE.height + 4}`], [svg, "width", CURVE.width], [svg, "height", CURVE.height + 4], [svg, "aria-hidden", "true"]]);
  svg.append(path);
  figure.append(svg, make("figcaption"));
  return figure;
}

function setAll(values) {
  for (const [element, name, value] of values) {
    if (element.getAttribute(name) !== String(value)) element.setAttribute(name, value);
  }
}

function details(on) {
  const now = Date.now() / 1000 + clock;
  const parts = [["h3", on.title]];
  const { cause } = seen.get(selected) || {};
  if (cause) {
    const names = [...cause.nodes].slice(0, MOST_CHOSEN).map((id) => labelOf(id, state.nodes.get(id)));
    parts.push(["p", cause.text], ["fix", cause.fix, on.title], ["p", names.length > 1 ? names.join(", ") : ""]);
  }
  if (selected.startsWith("n:")) {
    const id = selected.slice(2);
    const node = state.nodes.get(id) || {};
    const ports = node.ports ? `ports ${node.ports}` : "";
    const rate = node.rate === undefined ? "" : `${megabytes(node)} MB/s through it`;
    const period = node.since === undefined ? "" : ` for ${duration(now - node.since)}`;
    parts.push(["h3", on.title ? "" : labelOf(id, node)], ["p", `${node.detail || ""}${period}`], ["p", [node.place, node.address, ports, rate].filter(Boolean).join(" · ")],
      ["p", node.text || ""], ["fix", node.fix || "", labelOf(id, node)]);
  }
  const links = [...on.links.values()];
  for (const { id, link, from, to } of links.slice(0, MOST_CHOSEN)) {
    const minute = lastMinute(rates, id, link);
    const type = link.type ? ` (${link.type})` : "";
    const ends = [withPlace(from, link.source), to && withPlace(to, link.target)].filter(Boolean).join(" to ");
    parts.push(["p", `${WORDS[link.state || "unknown"]}: ${link.name}${type} from ${ends}, ${frequency(link) || "– Hz"}, ` +
      `${megabytes(link)} MB/s, last message ${age(link, now)}, carried by ${link.carried || "–"}, port ${link.port || "–"}`],
    ["figure", minute.length ? minuteText(minute, link.shared) : "", curveOf(minute, CURVE.width, CURVE.height)],
    ["p", link.text || ""], ["fix", link.text && !cause ? link.fix || "" : "", link.name]);
  }
  if (links.length > MOST_CHOSEN) parts.push(["p", `${links.length - MOST_CHOSEN} more are marked in the table.`]);
  return parts.filter(([, text]) => text);
}

// The label of a node, with the container, pod or address. The label may begin with the place.
function withPlace(label, id) {
  const place = placeOf(state.nodes.get(id));
  return place && !label.startsWith(place) ? `${label} at ${place}` : label;
}

// The address of the page has what is shown, and can be sent to others.
function writeAddress() {
  const words = new URLSearchParams();
  for (const [name, value] of Object.entries({ filter: chosen.filter, quiet: chosen.quiet, unfold: chosen.unfoldAll, chosen: selected })) {
    if (value) words.set(name, value);
  }
  for (const [key, open] of chosen.turned) words.append(open ? "open" : "fold", key);
  if (String(words) !== location.hash.slice(1)) history.replaceState(null, "", `#${words}`);
}

function readAddress() {
  if (!location.hash.includes("=")) return;
  const words = new URLSearchParams(location.hash.slice(1));
  chosen.filter = $("filter").value = words.get("filter") || "";
  chosen.quiet = $("quiet").checked = words.has("quiet");
  chosen.unfoldAll = $("unfold").checked = words.has("unfold");
  chosen.turned = new Map([...words.getAll("open").map((key) => [key, true]), ...words.getAll("fold").map((key) => [key, false])]);
  selected = words.get("chosen") || "";
}

function start() {
  readAddress();
  addEventListener("hashchange", () => { readAddress(); draw(); });
  new ResizeObserver(draw).observe($("graph"));
  $("controls").addEventListener("submit", (event) => event.preventDefault());
  $("filter").addEventListener("input", (event) => { chosen.filter = event.target.value; chosen.depths = {}; draw(); });
  $("quiet").addEventListener("change", (event) => { chosen.quiet = event.target.checked; draw(); });
  $("unfold").addEventListener("change", (event) => {
    chosen.unfoldAll = event.target.checked;
    chosen.turned.clear();
    draw();
  });
  addEventListener("keydown", (event) => { if (event.key === "Escape" && selected) choose(selected, false); });
  setInterval(() => { note(); draw(); watch(); }, 1000); // ages grow
  // For tests, and whoever looks into it.
  window.rosproxyPage = { state };
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

function putAt(element, { x, y, w, h }) {
  const at = `${x} ${y} ${w} ${h}`;
  if (element.dataset.at === at) return;
  element.dataset.at = at;
  Object.assign(element.style, { left: `${x}px`, top: `${y}px`, width: `${w}px`, height: `${h}px` });
}

function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

// The same for a text with names, which may break after each slash.
function putName(element, text) {
  if (element.textContent === text) return;
  element.replaceChildren(...text.split(/(?<=[^/]\/)/).flatMap((part) => [part, make("wbr")]).slice(0, -1));
}

start();
