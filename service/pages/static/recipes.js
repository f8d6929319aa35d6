// Shared by the forms of recipes (noise sweep, re-identification): models, channels, numbers.

import { address, ask, makeElement, keepLatest } from './live.js';
import { fillTable, parseNumber } from './fields.js';

const fetchModel = keepLatest((name) => ask(address(`/v1/models/${encodeURIComponent(name)}`)));

/**
 * Load the chosen model and fill its table of bounds. Return its document, or null if another
 * model was chosen meanwhile. The old table is cleared at once, so that no typed value is lost.
 */
export async function loadChosenModel(form) {
  fillTable({}, {});
  const answer = await fetchModel(form.elements.model.value);
  if (!answer) return null;
  fillTable(answer.document, {});
  return answer.document;
}

export const listInputs = (model) => Object.keys(model.inputs ?? {});
const listOutputs = (model) => Object.keys(model.outputs ?? (model.output ? { [model.output]: 0 } : {}));

/** Draw one choice per signal of the model: the channel of the same name, else the one at the same place. */
export function drawChannels(model, recorded) {
  const signals = [...listInputs(model), ...listOutputs(model)];
  const choices = signals.map((signal, place) => {
    const label = makeElement('label', `${place < listInputs(model).length ? 'input' : 'output'} ${signal}`);
    const select = document.createElement('select');
    select.dataset.signal = signal;
    select.dataset.pointer = `/channels/${signal}`;
    recorded.forEach((name) => select.append(new Option(name, name)));
    select.value = recorded.includes(signal) ? signal : recorded[Math.min(place, recorded.length - 1)];
    label.append(select);
    return label;
  });
  const hint = makeElement('small', 'choose a recording first', 'muted');
  document.getElementById('channels').replaceChildren(...(recorded.length ? choices : [hint]));
}

export const readChannels = (form) =>
  Object.fromEntries([...form.querySelectorAll('[data-signal]')].map((select) => [select.dataset.signal, select.value]));

/**
 * Parse numbers between commas, semicolons or spaces, or `start:stop:step` with both ends. Commas
 * between digits separate only beside decimal points: 0,05 may be one number. Such a text is sent as typed.
 */
export function parseNumbers(text) {
  const parts = text.split(':').map(parseNumber);
  if (parts.length === 3 && parts.every(Number.isFinite) && parts[2] > 0 && parts[1] >= parts[0]) {
    const [start, stop, step] = parts;
    const count = Math.min(Math.floor((stop - start) / step + 1e-9) + 1, 100_001);
    return Array.from({ length: count }, (_, k) => Number((start + k * step).toPrecision(12)));
  }
  if (!text.includes(';') && !text.includes('.') && /\d,\d/.test(text)) return [text.trim()];
  return text.split(text.includes(';') ? /[;\s]+/ : /[,\s]+/).filter(Boolean).map(parseNumber);
}
