// The charts of the live page. A frame is asked for when the last one is drawn: a browser that is
// slow, or shows another tab, asks for fewer.

const NUMBERS = 3;           // states/s, loop time s/s, messages missed; then the sizes of the curves
const ENOUGH_MS = 25;        // a frame that took longer is followed by as long a rest
const AGAIN_MS = 1000;       // after the connection was lost

// charts: ids of elements of ECharts, each with the number of its curves; rate: id of a label.
window.asiLive = function (charts, rate, windowS) {
  let counted = 0, since = performance.now(), asked, socket;

  function connect() {
    socket = new WebSocket(`ws://${location.host}/frames`);
    socket.binaryType = "arraybuffer";
    socket.onopen = ask;
    socket.onmessage = (event) => requestAnimationFrame(() => draw(new Float32Array(event.data)));
    socket.onclose = () => setTimeout(connect, AGAIN_MS);
  }

  function ask() {
    asked = performance.now();
    if (socket.readyState === WebSocket.OPEN) socket.send(String(asiLive.windowS));
  }

  function draw(frame) {
    let size = NUMBERS;
    let place = NUMBERS + charts.reduce((sum, [, curves]) => sum + curves, 0);
    for (const [id, curves] of charts) {
      const series = [];
      for (let k = 0; k < curves; k++) {
        const end = place + 2 * frame[size++];
        series.push({ data: pairs(frame, place, end) });
        place = end;
      }
      // Without `getOption`, which copies all of it, as the element's own update does.
      getElement(id)?.chart?.setOption({ series }, { lazyUpdate: true, silent: true });
    }
    counted++;
    tell(frame);
    const took = performance.now() - asked;
    setTimeout(ask, took > ENOUGH_MS ? took : 0);
  }

  function pairs(frame, begin, end) {
    const points = [];
    for (let k = begin; k < end; k += 2) points.push([frame[k], frame[k + 1]]);
    return points;
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

  asiLive.windowS = windowS;
  connect();
};
