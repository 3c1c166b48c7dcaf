// What is wrong, one entry for each cause, and what happened: pure functions, without a DOM.

import { labelOf, placeOf, RANK } from "./view.js";

const MOST_EVENTS = 50;

// The causes, the worst first. What has one fix and one place (a container or a machine) is one
// cause: a container that ends, or a firewall, leaves many links with a problem. Names of nodes and
// numbers, such as ports, make no other fix. Pods behind two proxies may have the same name.
export function causesOf({ nodes, links, findings }) {
  const causes = new Map();
  const add = (kind, { place, proxy = "", container = "" }, { what, text, fix }, ids, names = []) => {
    const shape = names.reduce((rest, name) => rest.replaceAll(name, ""), fix || text).replace(/\d+/g, "");
    const key = `f:${JSON.stringify([kind, proxy, place, shape])}`;
    if (!causes.has(key)) causes.set(key, { key, kind, place, container, what, text, fix, count: 0, nodes: new Set(), links: new Set() });
    const cause = causes.get(key);
    cause.count += 1;
    if (ids.node) cause.nodes.add(ids.node);
    if (ids.link) cause.links.add(ids.link);
  };
  for (const one of findings) {
    add(one.severity === "error" ? "broken" : "warning", { place: subjectPlace(one.subject) }, { what: one.subject, text: one.text, fix: one.fix }, {});
  }
  for (const [id, node] of nodes) {
    if (isWrong(node)) add(node.state, whereOf(node), { what: labelOf(id, node) + behind([node]), text: node.text || "", fix: node.fix || "" }, { node: id }, [id, labelOf(id, node)]);
  }
  for (const [id, link] of links) {
    if (!isWrong(link)) continue;
    const ends = [link.source, link.target].filter(Boolean);
    const labels = ends.map((end) => labelOf(end, nodes.get(end)));
    const what = `${link.name} from ${labels.join(" to ")}${behind(ends.map((end) => nodes.get(end)))}`;
    add(link.state, whereOf(nodeOf(link, ends, nodes)), { what, text: link.text || "", fix: link.fix || "" }, { link: id }, [...ends, ...labels]);
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

export function titleOf({ what, count, place, container }) {
  if (count > 1) return `${count}${place ? ` at ${place}` : " times"}: ${what}, …`;
  return container ? `${what}, in ${container}` : what;
}

// Note which causes are new and which are over. `seen`: the causes by their keys, with the time of
// their beginning in milliseconds; those of the first document are `old`, and began earlier.
// Returns the events, the newest first.
export function follow(seen, causes, events, now, isFirst) {
  const found = [];
  const present = new Set(causes.map(({ key }) => key));
  for (const [key, { cause, since }] of seen) {
    if (present.has(key)) continue;
    seen.delete(key);
    found.push({ at: now, over: true, kind: cause.kind, title: titleOf(cause), since });
  }
  for (const cause of causes) {
    const { since, old } = seen.get(cause.key) || { since: now, old: isFirst };
    if (!seen.has(cause.key) && !isFirst) found.push({ at: now, over: false, kind: cause.kind, title: titleOf(cause), since });
    seen.set(cause.key, { cause, since, old });
  }
  return [...found, ...events].slice(0, MOST_EVENTS);
}
