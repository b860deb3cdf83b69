// A gamepad's sticks and buttons as strokes of the page's keys, in the browser that the
// gamepad is plugged into. The layout is the W3C's standard one.
const PERIOD = 50; // from one look to the next [ms]
const RATE = 10; // strokes per second of a stick at its end
const DEAD = 0.15; // a stick nearer to its middle is at rest
const STICKS = [[0, "L", "J"], [1, "K", "I"], [3, "O", "U"]]; // axis, its key of + and -
const BUTTONS = { 0: "R", 1: "X", 2: "T", 3: "N", 12: "P", 13: "M" };
const TURN = 5; // the button that makes the sticks turn the target

function press(key, shiftKey) {
  const stroke = new KeyboardEvent("keydown", { key, shiftKey, bubbles: true });
  document.documentElement.dispatchEvent(stroke);
}

function watch() {
  const owed = STICKS.map(() => 0);
  let before = new Set();
  setInterval(() => {
    const pad = navigator.getGamepads().find((found) => found && found.connected);
    if (!pad) return;
    const down = (k) => Boolean(pad.buttons[k] && pad.buttons[k].pressed);
    STICKS.forEach(([axis, plus, minus], i) => {
      const value = pad.axes[axis] || 0;
      owed[i] = Math.abs(value) < DEAD ? 0 : owed[i] + (value * RATE * PERIOD) / 1000;
      if (Math.abs(owed[i]) < 1) return;
      press(owed[i] > 0 ? plus : minus, down(TURN));
      owed[i] -= Math.sign(owed[i]);
    });
    const pressed = new Set(Object.keys(BUTTONS).filter(down));
    pressed.forEach((k) => before.has(k) || press(BUTTONS[k], false));
    before = pressed;
  }, PERIOD);
}

if (!window.gamepadIsWatched) watch();
window.gamepadIsWatched = true;
