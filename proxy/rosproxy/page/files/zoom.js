// Zoom and pan of the graph. The browser lays the graph out larger, so text stays sharp and the
// graph scrolls as before: with the wheel, the arrow keys and the finger.

const STEP = 1.25;
const LEAST = 0.92; // text of 12 px then has 11 px
const MOST = 4;
const STILL = 4; // pixels; a pointer that moves less clicks

const limited = (zoom) => Math.min(MOST, Math.max(LEAST, zoom));

// `graph` scrolls `content`. `less`, `more`, `fit`: buttons; `level`: the text between the buttons.
// `layOut` is called if the lanes have another width. Returns a function that returns the zoom.
export function zoomable(graph, content, { less, more, fit, level }, layOut) {
  let zoom = 1;
  // `x`, `y`: the point in `graph` that stays where it is.
  const set = (wanted, x = graph.clientWidth / 2, y = graph.clientHeight / 2) => {
    const next = limited(wanted);
    const by = next / zoom;
    const [left, top] = [(graph.scrollLeft + x) * by - x, (graph.scrollTop + y) * by - y];
    const isOther = Math.min(1, next) !== Math.min(1, zoom);
    zoom = next;
    content.style.zoom = zoom;
    less.disabled = zoom <= LEAST;
    more.disabled = zoom >= MOST;
    level.textContent = `${Math.round(100 * zoom)} %`;
    if (isOther) layOut();
    graph.scrollTo(left, top);
  };
  // The lanes fill the width already if the zoom is at most 1.
  const fitAll = () => {
    const height = content.getBoundingClientRect().height / zoom;
    set(Math.min(1, parseFloat(getComputedStyle(graph).maxHeight) / height));
    graph.scrollTo(0, 0);
  };
  const keys = { "+": () => set(zoom * STEP), "=": () => set(zoom * STEP), "-": () => set(zoom / STEP), 0: fitAll };
  less.addEventListener("click", keys["-"]);
  more.addEventListener("click", keys["+"]);
  fit.addEventListener("click", fitAll);
  graph.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return; // zoom of the browser
    event.preventDefault();
    keys[event.key]();
  });
  // Browsers report two fingers on a touchpad as a wheel with the Ctrl key.
  graph.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return;
    event.preventDefault();
    const { left, top } = graph.getBoundingClientRect();
    set(zoom * Math.exp(-event.deltaY / 300), event.clientX - left, event.clientY - top);
  }, { passive: false });
  pan(graph);
  return () => zoom;
}

// The pressed mouse moves what `graph` shows. A finger scrolls without this.
function pan(graph) {
  let last = null;
  let moves = false;
  graph.addEventListener("pointerdown", (event) => {
    moves = false;
    last = event.pointerType === "mouse" && event.button === 0 ? event : null;
  });
  graph.addEventListener("pointermove", (event) => {
    if (event.buttons !== 1) last = null; // released, also outside the graph
    if (!last) return;
    const [x, y] = [last.clientX - event.clientX, last.clientY - event.clientY];
    if (!moves && Math.hypot(x, y) < STILL) return;
    moves = true;
    graph.setPointerCapture(event.pointerId);
    graph.scrollBy(x, y);
    last = event;
  });
  graph.addEventListener("click", (event) => {
    if (moves && event.detail) event.stopPropagation(); // a click of the keyboard has no detail
    moves = false;
  }, true);
}
