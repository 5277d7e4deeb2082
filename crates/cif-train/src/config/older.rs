//! Settings recorded by earlier versions.

use serde_json::{Map, Value};

use super::TrainConfig;

/// Settings that there are no longer, with the value that leaves a run as it is without them.
fn removed() -> [(&'static str, Value); 2] {
    [("/stages/tile_share", 1.0.into()), ("/adam/fresh_row_bias_correction", false.into())]
}

/// Settings that there were not, with the value that runs went by.
fn added() -> [(&'static str, Value); 7] {
    [
        ("/resample/weakness", "occupancy".into()),
        ("/model/triangulate", false.into()),
        ("/identity/share_rounds", 0.into()),
        ("/densify/rule", "gradient".into()),
        ("/stages/half_size", 0.into()),
        ("/stages/reduction", 1.into()),
        ("/densify/detail", 0.into()),
    ]
}

/// The table that holds a setting, and its key.
fn place<'a>(json: &'a mut Value, path: &'static str) -> Option<(&'a mut Map<String, Value>, &'static str)> {
    let (parent, key) = path.rsplit_once('/')?;
    Some((json.pointer_mut(parent)?.as_object_mut()?, key))
}

impl TrainConfig {
    /// Settings as this or an earlier version recorded them.
    ///
    /// # Errors
    /// When they are none, or ask for something that this version cannot do, by name.
    pub fn recorded(mut json: Value) -> Result<Self, String> {
        for (path, harmless) in removed() {
            if let Some(value) = place(&mut json, path).and_then(|(table, key)| table.remove(key))
                && value != harmless
            {
                let name = path.trim_start_matches('/').replace('/', ".");
                return Err(format!(
                    "it was trained with {name} = {value}, which this version no longer has"
                ));
            }
        }
        for (path, former) in added() {
            if let Some((table, key)) = place(&mut json, path) {
                table.entry(key).or_insert(former);
            }
        }
        serde_json::from_value(json).map_err(|error| error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::super::{DensifyRule, Weakness};
    use super::*;

    #[test]
    fn settings_that_did_nothing_are_dropped_others_are_named_and_new_ones_stay_as_they_were() {
        let config = TrainConfig { seed: 9, ..TrainConfig::default() };
        let mut json = serde_json::to_value(&config).unwrap();
        assert_eq!(TrainConfig::recorded(json.clone()).unwrap(), config);
        json["stages"]["tile_share"] = 1.0.into();
        json["adam"]["fresh_row_bias_correction"] = false.into();
        assert_eq!(TrainConfig::recorded(json.clone()).unwrap(), config);
        json["resample"].as_object_mut().unwrap().remove("weakness");
        json["densify"].as_object_mut().unwrap().remove("rule");
        json["stages"].as_object_mut().unwrap().remove("half_size");
        json["stages"].as_object_mut().unwrap().remove("reduction");
        json["densify"].as_object_mut().unwrap().remove("detail");
        let former = TrainConfig::recorded(json.clone()).unwrap();
        assert_eq!(
            (former.resample.weakness, former.densify.rule, former.stages.half_size),
            (Weakness::Occupancy, DensifyRule::Gradient, 0.0)
        );
        assert_eq!((former.stages.reduction, former.densify.detail), (1, 0.0));
        json["stages"]["tile_share"] = 0.5.into();
        let error = TrainConfig::recorded(json).unwrap_err();
        assert!(error.contains("stages.tile_share = 0.5"), "{error}");
        assert!(TrainConfig::recorded(serde_json::json!({ "stages": 7 })).is_err());
    }
}
