"use strict";
const figures = JSON.parse(document.getElementById("figures").textContent);
const dark = window.matchMedia("(prefers-color-scheme: dark)");

// Plotly does not read CSS: the page's colours reach it as a template.
function template() {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(name).trim();
  const axis = {
    gridcolor: colour("--line"), zerolinecolor: colour("--line"), linecolor: colour("--line"),
    color: colour("--quiet"), automargin: true,
  };
  const space = { ...axis, showbackground: false };
  return {
    layout: {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: colour("--ink"), family: getComputedStyle(document.body).fontFamily, size: 12 },
      xaxis: axis, yaxis: axis, scene: { xaxis: space, yaxis: space, zaxis: space },
      showlegend: false, margin: { l: 50, r: 10, t: 10, b: 40 },
      hoverlabel: { bgcolor: colour("--paper"), font: { color: colour("--ink") } },
    },
  };
}

// A 3D figure is as wide as the page; the numbers of its axes need some room.
function stepBack(layout, width) {
  const eye = layout.scene.camera.eye;
  for (const axis of "xyz") eye[axis] *= 1.15;
  layout.height = width;
}

// On a narrow page, panels side by side would be too small: stack them.
function stack(layout) {
  const names = Object.keys(layout).filter((name) => /^(xaxis|polar)\d*$/.test(name));
  const n = names.length, each = layout.height > 300 ? 320 : 230;
  names.forEach((name, k) => {
    const y = [1 - (k + 0.78) / n, 1 - k / n];
    if (name.startsWith("polar")) layout[name].domain = { x: [0, 1], y };
    else {
      layout[name].domain = [0, 1];
      layout[name.replace("x", "y")].domain = y;
    }
  });
  layout.annotations?.forEach((note, k) => Object.assign(note, { x: 0, y: 1 - (k + 0.78) / n }));
  layout.height = 70 + each * n;
}

const options = { responsive: true, displaylogo: false, displayModeBar: false };
const places = document.querySelectorAll(".plot"), NARROW = 560;
let shown = "0"; // the group of traces that the switch shows
function visible(trace) {
  return trace.meta === undefined || String(trace.meta) === shown;
}
function draw(place) {
  const { data, layout } = figures[place.dataset.figure];
  const panels = Object.keys(layout).filter((name) => /^(xaxis|polar)\d+$/.test(name));
  if (panels.length && place.clientWidth < NARROW) stack(layout);
  if (layout.scene && place.clientWidth < layout.height) stepBack(layout, place.clientWidth);
  for (const trace of data) trace.visible = visible(trace);
  place.style.height = `${layout.height}px`;
  Plotly.newPlot(place, data, { ...layout, template: template() }, options);
}
// On a narrow page the verdict, the arrows and what is missing come first; the rest unfolds.
if (innerWidth < NARROW) {
  for (const name of ["history", "error-budget", "residuals-against-quantities"]) {
    for (const part of document.querySelectorAll(`#${name} > details`)) part.open = false;
  }
}
// A folded or hidden part has no width: draw its figures when they are first visible.
const unseen = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    if (!isIntersecting) continue;
    unseen.unobserve(target);
    if (!target.data) draw(target);
  }
}, { rootMargin: "400px" });
for (const place of places) unseen.observe(place);
// A picture or a print of the whole page needs the others, too: draw them while the page is idle.
const whenIdle = window.requestIdleCallback ?? ((act) => setTimeout(act, 200));
function drawNext() {
  const isOpen = (place) => !place.data && !place.closest("details:not([open]), [hidden]");
  const next = [...places].find(isOpen);
  if (!next) return;
  draw(next);
  whenIdle(drawNext);
}
addEventListener("load", () => whenIdle(drawNext));
dark.addEventListener("change", () => {
  for (const place of places) if (place.data) Plotly.relayout(place, { template: template() });
});

// The switch acts on every view at once.
const switches = document.querySelectorAll(".switch button");
for (const button of switches) {
  button.addEventListener("click", () => {
    shown = button.value;
    for (const other of switches) other.setAttribute("aria-pressed", other.value === shown);
    for (const place of places) {
      if (place.data) Plotly.restyle(place, { visible: place.data.map(visible) });
    }
  });
}

for (const list of document.querySelectorAll("[role=tablist]")) {
  const buttons = [...list.children], panels = [...list.parentNode.children].slice(1);
  buttons.forEach((button, k) => {
    button.addEventListener("click", () => {
      buttons.forEach((other, i) => other.setAttribute("aria-selected", i === k));
      panels.forEach((panel, i) => { panel.hidden = i !== k; });
    });
  });
}

// The contents; a click opens the section.
const contents = document.querySelector("nav");
for (const title of document.querySelectorAll("section h2")) {
  const link = document.createElement("a"), part = title.closest("section");
  link.href = `#${part.id}`;
  link.textContent = title.textContent;
  link.addEventListener("click", () => { part.querySelector("details").open = true; });
  contents.append(link);
}

// In print nothing is folded, and every figure is as wide as the paper. Three views of equal scale
// and one in space would leave most of their height empty there.
function fit(place) {
  if (!place.data) draw(place);
  const width = place.clientWidth, { layout } = figures[place.dataset.figure];
  const views = layout.yaxis?.scaleanchor && layout.xaxis3 && !layout.xaxis4;
  const share = views ? 0.36 : layout.scene ? 0.45 : 0;
  const height = share ? Math.min(layout.height, share * width) : layout.height;
  place.style.height = `${height}px`;
  Plotly.relayout(place, { width, height, template: template() });
}
window.addEventListener("beforeprint", () => {
  document.documentElement.classList.add("printing");
  for (const part of document.querySelectorAll("details")) part.open = true;
  for (const panel of document.querySelectorAll("[role=tabpanel]")) panel.hidden = false;
  for (const place of places) fit(place);
});
window.addEventListener("afterprint", () => {
  document.documentElement.classList.remove("printing");
  for (const list of document.querySelectorAll("[role=tablist]")) {
    list.querySelector("[aria-selected=true]")?.click();
  }
  for (const place of places) {
    const { height } = figures[place.dataset.figure].layout;
    place.style.height = `${height}px`;
    if (place.data) Plotly.relayout(place, { width: null, height, autosize: true });
  }
});

function sortBy(table, column, head) {
  const up = head.getAttribute("aria-sort") === "descending";
  for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", up ? "ascending" : "descending");
  const key = (row) => row.cells[column].dataset.key ?? row.cells[column].textContent;
  const sign = up ? 1 : -1;
  const rows = [...table.tBodies[0].rows];
  rows.sort((a, b) => sign * key(a).localeCompare(key(b), "en", { numeric: true }));
  const numbers = rows.every((row) => row.cells[column].dataset.key !== undefined);
  if (numbers) rows.sort((a, b) => sign * (key(a) - key(b)));
  table.tBodies[0].append(...rows);
}

for (const table of document.querySelectorAll(".sortable table")) {
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    head.addEventListener("click", () => sortBy(table, column, head));
  });
}
