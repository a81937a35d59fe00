// The charts of the live page, drawn on canvases. Another frame is asked for when one has come, and
// the screen shows the newest: a browser that is slow, or shows another tab, asks for fewer.

const AHEAD = 3;             // frames asked for at a time: one on each way, one to draw
const NUMBERS = 3;           // states/s, loop time s/s, messages missed; then the sizes of the curves
const AGAIN_MS = 1000;       // after the connection was lost
const EDGE = { left: 60, right: 15, top: 28, bottom: 22 };
const COLOURS = ["#0072b2", "#d55e00"];
const FONT = "12px sans-serif", BOLD = "bold 13px sans-serif";
const TICKS = { x: 8, y: 5 };   // about so many

// charts: id of a canvas, title, unit of x, names of the curves; rate: id of a label.
window.asiLive = function (charts, rate, windowS) {
  let counted = 0, since = performance.now(), asked = 0, newest, drawing, socket;
  asiLive.windowS = windowS;
  // What is shown, for tests: of each title the points of each curve.
  asiLive.curves = () => Object.fromEntries(
    newest ? parts(newest).map(([[, title, , names], curves]) => [title, Object.fromEntries(
      names.map((name, k) => [name, pairs(curves[k])]))]) : []);
  document.addEventListener("visibilitychange", ask);
  connect();

  function connect() {
    socket = new WebSocket(`ws://${location.host}/frames`);
    socket.binaryType = "arraybuffer";
    socket.onopen = ask;
    socket.onmessage = (event) => {
      newest = new Float32Array(event.data);
      asked--;
      ask();
      if (!drawing) drawing = requestAnimationFrame(draw);
    };
    socket.onclose = () => {
      asked = 0;
      setTimeout(connect, AGAIN_MS);
    };
  }

  function ask() {
    if (document.hidden || socket.readyState !== WebSocket.OPEN) return;
    for (; asked < AHEAD; asked++) socket.send(String(asiLive.windowS));
  }

  function draw() {
    drawing = 0;
    for (const [[id, title, unit, names], curves] of parts(newest)) {
      const canvas = document.getElementById(id);
      if (canvas) drawChart(canvas, title, unit, names, curves);
    }
    counted++;
    tell(newest);
  }

  // Each chart with its curves, which are views: x, y, x, y, ...
  function parts(frame) {
    let size = NUMBERS;
    let place = NUMBERS + charts.reduce((sum, [, , , names]) => sum + names.length, 0);
    return charts.map((chart) => [chart, chart[3].map(
      () => frame.subarray(place, (place += 2 * frame[size++])))]);
  }

  function pairs(curve) {
    return Array.from({ length: curve.length / 2 }, (_, k) => [curve[2 * k], curve[2 * k + 1]]);
  }

  function tell(frame) {
    const passed = performance.now() - since;
    if (passed < 1000) return;
    document.getElementById(rate).textContent =
      `${frame[0].toFixed()} states/s, ${frame[1].toFixed(2)} s of loop time a second, ` +
      `${frame[2].toFixed()} missed here; ${((1000 * counted) / passed).toFixed()} frames/s`;
    counted = 0;
    since = performance.now();
  }
};

function drawChart(canvas, title, unit, names, curves) {
  const scale = window.devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const on = canvas.getContext("2d", { alpha: false });
  on.setTransform(scale, 0, 0, scale, 0, 0);
  on.fillStyle = "white";
  on.fillRect(0, 0, width, height);
  const x = axis(curves, 0, TICKS.x, EDGE.left, width - EDGE.right);
  const y = axis(curves, 1, TICKS.y, height - EDGE.bottom, EDGE.top);
  drawAxes(on, x, y, unit);
  drawLegend(on, title, names, width);
  curves.forEach((curve, k) => drawCurve(on, curve, x, y, COLOURS[k]));
}

// Pixels = offset + factor * value, of a range of values that ends at ticks.
function axis(curves, first, wanted, begin, end) {
  let low = Infinity, high = -Infinity;
  for (const curve of curves) {
    for (let k = first; k < curve.length; k += 2) {
      if (curve[k] < low) low = curve[k];
      if (curve[k] > high) high = curve[k];
    }
  }
  if (low > high) low = high = 0;
  if (high - low < 1e-6 * Math.max(Math.abs(low), 1e-3)) {
    low -= 0.5;
    high += 0.5;
  }
  const rough = (high - low) / wanted, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((each) => each * power >= 0.999 * rough);
  const from = Math.floor(low / step + 1e-6), to = Math.ceil(high / step - 1e-6);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-6));
  const factor = (end - begin) / ((to - from) * step);
  const ticks = Array.from({ length: to - from + 1 }, (_, k) => (from + k) * step);
  return { begin, end, factor, offset: begin - from * step * factor, ticks, digits };
}

function drawAxes(on, x, y, unit) {
  on.font = FONT;
  on.lineWidth = 1;
  on.strokeStyle = "#e0e0e0";
  on.fillStyle = "#555";
  on.beginPath();
  on.textAlign = "right";
  on.textBaseline = "middle";
  for (const tick of y.ticks) {
    const at = Math.round(y.offset + y.factor * tick) + 0.5;
    on.moveTo(x.begin, at);
    on.lineTo(x.end, at);
    on.fillText(tick.toFixed(y.digits), x.begin - 6, at);
  }
  on.textAlign = "center";
  on.textBaseline = "top";
  for (const [k, tick] of x.ticks.entries()) {
    const at = Math.round(x.offset + x.factor * tick) + 0.5;
    const end = k === x.ticks.length - 1 && unit ? ` ${unit}` : "";
    on.moveTo(at, y.begin);
    on.lineTo(at, y.end);
    on.fillText(tick.toFixed(x.digits) + end, at, y.begin + 5);
  }
  on.stroke();
}

function drawLegend(on, title, names, width) {
  on.textBaseline = "middle";
  on.textAlign = "left";
  on.fillStyle = "#333";
  on.font = BOLD;
  on.fillText(title, EDGE.left, EDGE.top / 2);
  on.font = FONT;
  on.textAlign = "right";
  let at = width - EDGE.right;
  for (let k = names.length - 1; k >= 0; k--) {
    on.fillText(names[k], at, EDGE.top / 2);
    at -= on.measureText(names[k]).width + 24;
    on.strokeStyle = COLOURS[k];
    on.lineWidth = 3;
    on.beginPath();
    on.moveTo(at, EDGE.top / 2);
    on.lineTo(at + 18, EDGE.top / 2);
    on.stroke();
    at -= 15;
  }
}

function drawCurve(on, curve, x, y, colour) {
  on.strokeStyle = colour;
  on.lineWidth = 1;   // a wider line takes 15 times as long where it is dense
  on.beginPath();
  for (let k = 0; k < curve.length; k += 2) {
    on.lineTo(x.offset + x.factor * curve[k], y.offset + y.factor * curve[k + 1]);
  }
  on.stroke();
}
