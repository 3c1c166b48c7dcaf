// What is wrong with the picture of the graph: what an engineer would complain of.

const found = [];
const rectOf = (one) => one.getBoundingClientRect();
const name = (one) => one.title.split("\n")[0] || one.textContent;
const meet = (p, q) => p.left < q.right - 0.5 && q.left < p.right - 0.5
  && p.top < q.bottom - 0.5 && q.top < p.bottom - 0.5;
const boxes = [...document.querySelectorAll("#boxes .box")].map((box) => ({ box, rect: rectOf(box) }));
const texts = boxes.flatMap(({ box }) => [...box.children]).filter((one) => one.textContent);
const labels = texts.map((one) => ({ text: one.textContent, rect: rectOf(one) }));
const whole = rectOf(document.querySelector("#picture"));
const zoom = whole.width / document.querySelector("#lines").viewBox.baseVal.width;
for (const one of [...texts, ...document.querySelectorAll("#lanes span")]) {
  const size = zoom * parseFloat(getComputedStyle(one).fontSize);
  if (size < 11) found.push(`${one.textContent} has ${size} px`);
}
for (const all of [labels, boxes.map(({ box, rect }) => ({ text: name(box), rect }))]) {
  for (let i = 0; i < all.length; i += 1) for (let k = i + 1; k < all.length; k += 1) {
    if (meet(all[i].rect, all[k].rect)) found.push(`${all[i].text} and ${all[k].text} overlap`);
  }
}
for (const { text, rect } of labels) if (rect.width < 20) found.push(`no room for ${text}`);
const heads = [...document.querySelectorAll("#lanes span")].map(rectOf);
for (const { box, rect } of boxes) {
  if (rect.left < whole.left || rect.right > whole.right || rect.top < whole.top || rect.bottom > whole.bottom) {
    found.push(`${name(box)} is outside of the picture`);
  }
  if (!heads.some((head) => rect.left >= head.left - 1 && rect.right <= head.right + 1)) found.push(`${name(box)} has no heading`);
}
const page = document.documentElement;
if (page.scrollWidth > innerWidth) found.push(`the page has ${page.scrollWidth} of ${innerWidth} px`);
const graph = document.querySelector("#graph");
const used = Math.max(...boxes.map(({ rect }) => rect.right)) - Math.min(...boxes.map(({ rect }) => rect.left));
if (used < 0.96 * graph.clientWidth) found.push(`the lanes fill ${used} of ${graph.clientWidth} px`);
const byId = new Map(boxes.map((one) => [one.box.dataset.id, one]));
for (const group of document.querySelectorAll("#lines g")) {
  const id = group.dataset.id;
  const [a, b, via] = JSON.parse(id.slice(2));
  const frame = rectOf([...document.querySelectorAll(".frame")].find((one) => one.dataset.id === `frame v:${via}`));
  const row = byId.get(id).rect;
  if (row.top < frame.top || row.bottom > frame.bottom) found.push(`${id} does not pass its proxy`);
  const foreign = boxes.filter(({ box }) => ![a, b, id].includes(box.dataset.id));
  const way = group.firstChild;
  const length = way.getTotalLength();
  for (let at = 0; at <= length; at += 4) {
    const point = way.getPointAtLength(at);
    const x = zoom * point.x + whole.left;
    const y = zoom * point.y + whole.top;
    const hit = foreign.find(({ rect }) => x > rect.left + 1 && x < rect.right - 1 && y > rect.top + 1 && y < rect.bottom - 1);
    if (hit) { found.push(`a line crosses ${name(hit.box)}`); break; }
  }
}
return { found: found.slice(0, 10), boxes: boxes.length, lines: document.querySelectorAll("#lines g").length };
