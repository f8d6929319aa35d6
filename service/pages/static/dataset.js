// A dataset's page: its signals, and its dialogs.

import './items.js';
import { start } from './figures.js';

start();
