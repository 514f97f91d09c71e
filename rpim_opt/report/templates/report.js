"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const number = (v, digits = 3) =>
  v !== 0 && (v < 1e-3 || v >= 1e6) ? v.toExponential(digits - 1) : Number(v.toPrecision(digits)).toString();
const millimetres = (v) => (v < 10 ? v.toFixed(3) : v < 100 ? v.toFixed(2) : v.toFixed(0)) + " mm";

function curve({ weight, residual, solution, error, of, takers, chosen, x, y }) {
  const slider = document.getElementById("weight"), says = document.getElementById("weight-says");
  const svg = slider.closest(".figures").querySelector("svg");
  const cursor = svg.appendChild(document.createElementNS(svg.namespaceURI, "circle"));
  for (const [name, value] of Object.entries({ id: "cursor", class: "cursor", r: 9 })) cursor.setAttribute(name, value);
  const show = (k) => {
    slider.value = k;
    cursor.setAttribute("cx", x[k]);
    cursor.setAttribute("cy", y[k]);
    const lines = [`weight ${number(weight[k])}${k === chosen ? " (chosen)" : ""}`,
      `residual norm ${number(residual[k], 5)} noise standard deviations`, `deviation norm ${number(solution[k], 4)} prior scales`,
      `mean error, ${of}: ${millimetres(error[k])}`, takers[k] ? `selected by ${takers[k]}` : "selected by no rule"];
    says.textContent = lines.join("\n");
    slider.setAttribute("aria-valuetext", lines[0]);
  };
  slider.addEventListener("input", () => show(Number(slider.value)));
  svg.addEventListener("pointermove", (event) => {
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const far = x.map((v, k) => Math.hypot(v - at.x, y[k] - at.y));
    show(far.indexOf(Math.min(...far)));
  });
  show(chosen);
}

function space({ points, labels, before, after }) {
  const svg = document.getElementById("space"), says = document.getElementById("space-says");
  const make = (name, kind) => {
    const item = document.createElementNS(svg.namespaceURI, name);
    item.setAttribute("class", kind);
    return svg.appendChild(item);
  };
  const floor = make("path", "floor"), box = make("path", "box"), vectors = make("path", "vectors line after"), dots = make("path", "points");
  const near = make("circle", "near"), names = ["x", "y", "z"].map(() => make("text", "axis"));
  const low = [0, 1, 2].map((i) => points.reduce((m, p) => Math.min(m, p[i]), Infinity));
  const high = [0, 1, 2].map((i) => points.reduce((m, p) => Math.max(m, p[i]), -Infinity));
  const middle = low.map((v, i) => (v + high[i]) / 2);
  const size = Math.max(Math.hypot(...low.map((v, i) => high[i] - v)), 1e-6);
  let turn = 30, lift = 20, when = "after", places = [];

  const project = (p) => {
    const a = (turn * Math.PI) / 180, b = (lift * Math.PI) / 180, d = p.map((v, i) => v - middle[i]);
    const across = Math.cos(a) * d[0] - Math.sin(a) * d[1], away = Math.sin(a) * d[0] + Math.cos(a) * d[1];
    const up = Math.cos(b) * d[2] + Math.sin(b) * away, scale = 400 / size;
    return [300 + scale * across, 210 - scale * up];
  };
  const place = (p) => project(p).map((v) => v.toFixed(1)).join(" ");
  const say = (text) => {
    says.textContent = `${text}Errors ${when} calibration, ${(when === "after" ? after : before).note}.`;
  };
  const draw = () => {
    const { lines } = when === "after" ? after : before;
    places = points.map(project);
    dots.setAttribute("d", points.map((p) => `M${place(p)}h0`).join(""));
    vectors.setAttribute("class", `vectors line ${when}`);
    vectors.setAttribute("d", points.map((p, k) => `M${place(p)}L${place(p.map((v, i) => v + lines[k][i]))}`).join(""));
    const corner = (k) => low.map((v, i) => ((k >> i) & 1 ? high[i] : v));
    const edges = [];
    for (let k = 0; k < 8; k++)
      for (let i = 0; i < 3; i++) if (!((k >> i) & 1)) edges.push(`M${place(corner(k))}L${place(corner(k | (1 << i)))}`);
    box.setAttribute("d", edges.join(""));
    floor.setAttribute("d", `M${[0, 1, 3, 2].map((k) => place(corner(k))).join("L")}Z`);
    names.forEach((name, i) => {  // beside the outermost of the four edges along this axis
      const middles = [0, 1, 2, 3].map((k) => {
        const [a, b] = [0, 1, 2].filter((j) => j !== i);
        return project(corner(((k & 1) << a) | ((k >> 1) << b)).map((v, j) => (j === i ? middle[j] : v)));
      });
      const side = i === 2 ? 0 : 1, [px, py] = middles.sort((p, q) => (side ? q[1] - p[1] : p[0] - q[0]))[0];
      name.textContent = `${"xyz"[i]} ${(high[i] - low[i]).toFixed(2)} m`;
      name.setAttribute("x", side ? px : px - 40);
      name.setAttribute("y", side ? py + 18 : py);
    });
    near.setAttribute("r", 0);
    svg.dataset.view = `${turn},${lift}`;
    say("");
  };
  const rotate = (across, up) => {
    turn = (turn + across + 360) % 360;
    lift = Math.max(-90, Math.min(90, lift + up));
    draw();
  };

  let from = null;
  svg.addEventListener("pointerdown", (event) => {
    from = [event.clientX, event.clientY];
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointerup", () => (from = null));
  svg.addEventListener("pointercancel", () => (from = null));
  svg.addEventListener("pointermove", (event) => {
    if (from) {
      rotate((event.clientX - from[0]) / 2, (event.clientY - from[1]) / 2);
      from = [event.clientX, event.clientY];
      return;
    }
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const far = places.map(([a, b]) => Math.hypot(a - at.x, b - at.y)), k = far.indexOf(Math.min(...far));
    const found = far[k] < 20;
    near.setAttribute("r", found ? 8 : 0);
    near.setAttribute("cx", places[k][0]);
    near.setAttribute("cy", places[k][1]);
    say(found ? `${labels[k]}: ${millimetres((when === "after" ? after : before).errors[k])}. ` : "");
  });
  const steps = { ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5] };
  svg.addEventListener("keydown", (event) => {
    if (!steps[event.key]) return;
    event.preventDefault();
    rotate(...steps[event.key]);
  });
  for (const button of document.querySelectorAll("button[data-view]"))
    button.addEventListener("click", () => {
      [turn, lift] = button.dataset.view.split(",").map(Number);
      draw();
    });
  for (const choice of document.querySelectorAll("input[name=when]"))
    choice.addEventListener("change", () => {
      when = choice.value;
      draw();
    });
  draw();
}

if (data.curve) curve(data.curve);
if (data.space) space(data.space);
