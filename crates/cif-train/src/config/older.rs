//! Settings recorded by earlier versions.

use serde_json::Value;

use super::TrainConfig;

/// Settings that there are no longer, with the value that leaves a run as it is without them.
fn removed() -> [(&'static str, Value); 2] {
    [("/stages/tile_share", 1.0.into()), ("/adam/fresh_row_bias_correction", false.into())]
}

impl TrainConfig {
    /// Settings as this or an earlier version recorded them.
    ///
    /// # Errors
    /// When they are none, or ask for something that this version cannot do, by name.
    pub fn recorded(mut json: Value) -> Result<Self, String> {
        for (path, harmless) in removed() {
            let Some((parent, key)) = path.rsplit_once('/') else { continue };
            let table = json.pointer_mut(parent).and_then(Value::as_object_mut);
            if let Some(value) = table.and_then(|table| table.remove(key))
                && value != harmless
            {
                let name = path.trim_start_matches('/').replace('/', ".");
                return Err(format!(
                    "it was trained with {name} = {value}, which this version no longer has"
                ));
            }
        }
        serde_json::from_value(json).map_err(|error| error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_that_did_nothing_are_dropped_and_others_are_named() {
        let config = TrainConfig { seed: 9, ..TrainConfig::default() };
        let mut json = serde_json::to_value(&config).unwrap();
        assert_eq!(TrainConfig::recorded(json.clone()).unwrap(), config);
        json["stages"]["tile_share"] = 1.0.into();
        json["adam"]["fresh_row_bias_correction"] = false.into();
        assert_eq!(TrainConfig::recorded(json.clone()).unwrap(), config);
        json["stages"]["tile_share"] = 0.5.into();
        let error = TrainConfig::recorded(json).unwrap_err();
        assert!(error.contains("stages.tile_share = 0.5"), "{error}");
        assert!(TrainConfig::recorded(serde_json::json!({ "stages": 7 })).is_err());
    }
}
