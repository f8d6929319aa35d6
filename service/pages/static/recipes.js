// What the forms of recipes (noise sweep, re-identification) share: models, channels, numbers.

import { ask, element, latest } from './live.js';
import { fillTable } from './fields.js';

const modelOf = latest((name) => ask(`/v1/models/${encodeURIComponent(name)}`));

/**
 * The document of the chosen model, with its table of bounds drawn anew; null where another was chosen meanwhile.
 * The table of the model before goes at once: what was typed into it now would be lost.
 */
export async function chosenModel(form) {
  fillTable({}, {});
  const found = await modelOf(form.elements.model.value);
  if (!found) return null;
  fillTable(found.document, {});
  return found.document;
}

export const inputsOf = (model) => Object.keys(model.inputs ?? {});
const outputsOf = (model) => Object.keys(model.outputs ?? (model.output ? { [model.output]: 0 } : {}));

/** One choice per signal of the model: a channel of the same name, else the one at the same place. */
export function drawChannels(model, recorded) {
  const signals = [...inputsOf(model), ...outputsOf(model)];
  const choices = signals.map((signal, place) => {
    const label = element('label', `${place < inputsOf(model).length ? 'input' : 'output'} ${signal}`);
    const select = document.createElement('select');
    select.dataset.signal = signal;
    select.dataset.pointer = `/channels/${signal}`;
    recorded.forEach((name) => select.append(new Option(name, name)));
    select.value = recorded.includes(signal) ? signal : recorded[Math.min(place, recorded.length - 1)];
    label.append(select);
    return label;
  });
  const hint = element('small', 'choose a recording first', 'muted');
  document.getElementById('channels').replaceChildren(...(recorded.length ? choices : [hint]));
}

export const channelsOf = (form) =>
  Object.fromEntries([...form.querySelectorAll('[data-signal]')].map((one) => [one.dataset.signal, one.value]));

/** A number as typed; text that is none goes to the server, which says what would be right. */
export function number(text) {
  const trimmed = String(text).trim();
  return trimmed === '' ? null : Number.isNaN(Number(trimmed)) ? trimmed : Number(trimmed);
}

/** Numbers between commas, or `start:stop:step` with both ends. */
export function numbers(text) {
  const parts = text.split(':').map(Number);
  if (parts.length === 3 && parts.every(Number.isFinite) && parts[2] > 0 && parts[1] >= parts[0]) {
    const [start, stop, step] = parts;
    const count = Math.min(Math.floor((stop - start) / step + 1e-9) + 1, 100_001);
    return Array.from({ length: count }, (_, k) => Number((start + k * step).toPrecision(12)));
  }
  return text.split(/[,;\s]+/).filter(Boolean).map(number);
}

/** Only the settings of the search that were typed. */
export function algorithmOf(form) {
  const found = {};
  for (const key of ['population', 'generations']) {
    const value = number(form.elements[key].value);
    if (value !== null) found[key] = value;
  }
  const evaluations = number(form.elements.evaluations.value);
  return evaluations === null ? found : { ...found, stop: { evaluations } };
}
